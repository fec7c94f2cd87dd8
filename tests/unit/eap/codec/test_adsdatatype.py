from __future__ import annotations

from eap.codec.adssymbol import AdsType, DataTypeEntry, encode_data_type


def test_number_lies_as_clients_read_it() -> None:
    """In the order in which the function parseAdsResponseDataType of ads-client takes it apart."""
    assert encode_data_type(DataTypeEntry("UINT", AdsType.UINT16, 2)) == (
        bytes.fromhex("31000000 01000000 00000000 00000000 02000000 00000000 12000000 01000000")
        + bytes.fromhex("0400 0000 0000 0000 0000")
        + b"UINT\0\0\0"
    )


def test_list_ends_with_its_dimension() -> None:
    octets = encode_data_type(DataTypeEntry("ARRAY [0..3] OF INT", AdsType.INT16, 8, "INT", 4))
    assert octets[:4] == len(octets).to_bytes(4, "little")
    assert octets[32:42] == bytes.fromhex("1300 0300 0000 0100 0000")
    assert octets[42:] == b"ARRAY [0..3] OF INT\0INT\0\0" + bytes.fromhex("00000000 04000000")
