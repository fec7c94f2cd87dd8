from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.coe import (
    EntryDescription,
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectDescription,
    ObjectRequest,
    SdoInfoHeader,
    SdoInfoOpcode,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.wirerecords import records

ENTRY = bytes.fromhex("1810 01 7f 0700 2000 0701 01000000 02000000 00000000 ffffff00") + b"Vendor"


def test_header_lies_as_on_the_wire() -> None:
    header = SdoInfoHeader(SdoInfoOpcode.LIST_RESPONSE, incomplete=1, fragments_left=3)
    assert header.encode() == bytes.fromhex("82 00 0300")


def test_object_description_is_read() -> None:
    read = ObjectDescription.decode(bytes.fromhex("1810 2300 04 09") + b"Identity\0")
    assert read == ObjectDescription(0x1018, 0x23, 4, 9, "Identity")


def test_entry_description_is_read() -> None:
    assert EntryDescription.decode(ENTRY) == EntryDescription(
        0x1018, 1, 7, 32, 0x0107, "Vendor", 1, b"\2\0\0\0", bytes(4), b"\xff\xff\xff\0"
    )


def test_entry_description_holds_only_what_is_flagged() -> None:
    read = EntryDescription.decode(bytes.fromhex("1810 01 17 0100 0100 0700 01") + b"Bit")
    assert (read.default, read.minimum, read.unit, read.name) == (b"\1", None, None, "Bit")


@pytest.mark.parametrize("cut", [0, 9, 10, 25])
def test_entry_description_that_lacks_what_it_flags_is_truncated(cut: int) -> None:
    with pytest.raises(TruncatedError, match="Entry"):
        EntryDescription.decode(ENTRY[:cut])


@pytest.mark.parametrize(
    "record", [SdoInfoHeader, ListRequest, ObjectRequest, EntryRequest, InfoError]
)
@given(data=st.data())
def test_round_trip_and_every_prefix_is_truncated(record: type, data: st.DataObject) -> None:
    value = data.draw(records(record))
    octets = value.encode()
    assert record.decode(octets) == value
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(octets[: data.draw(st.integers(0, len(octets) - 1))])


@pytest.mark.parametrize("record", [ObjectDescription, EntryDescription])
@given(noise=st.binary(max_size=40))
def test_garbage_decodes_or_raises_codec_error(record: type, noise: bytes) -> None:
    try:
        read = record.decode(noise)
    except CodecError:
        return
    assert read.index == int.from_bytes(noise[:2], "little")


def test_unknown_opcode_is_malformed() -> None:
    with pytest.raises(MalformedError, match="8 is not a valid SdoInfoOpcode"):
        SdoInfoHeader.decode(bytes.fromhex("08000000"))
