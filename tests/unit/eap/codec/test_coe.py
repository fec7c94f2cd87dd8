"""CoE header, SDO services and SDO information."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.coe import (
    CoeHeader,
    CoeService,
    Emergency,
    EntryDescription,
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectDescription,
    ObjectRequest,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
    SdoSegmentHeader,
    decode_message,
    decode_segment,
    describe_message,
    encode_abort,
    encode_initiate,
    encode_message,
    encode_plain,
    encode_segment,
    encode_segment_answer,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.vectors import Vector, load, load_message
from tests.support.wirerecords import records


def test_header_matches_wire_layout() -> None:
    assert CoeHeader(service=CoeService.SDO_RESPONSE).encode() == bytes.fromhex("0030")
    assert CoeHeader(0x1FF, service=CoeService.TX_PDO).encode() == bytes.fromhex("ff41")


def test_emergency_matches_wire_layout() -> None:
    emergency = Emergency(0x2310, 0x03, b"\1\2\3\4\5")
    octets = encode_message(CoeService.EMERGENCY, emergency.encode())
    assert octets == bytes.fromhex("0010 1023 03 0102030405")
    header, body = decode_message(octets)
    assert (header.service, Emergency.decode(body)) == (CoeService.EMERGENCY, emergency)


@pytest.mark.parametrize(
    "record",
    [
        CoeHeader, Emergency, SdoHeader, SdoSegmentHeader, SdoInfoHeader, ListRequest,
        ObjectRequest, EntryRequest, InfoError,
    ],
)  # fmt: skip
@given(data=st.data())
def test_round_trip_and_every_prefix_is_truncated(record: type, data: st.DataObject) -> None:
    value = data.draw(records(record))
    octets = value.encode()
    assert record.decode(octets) == value
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(octets[: data.draw(st.integers(0, len(octets) - 1))])


@given(st.sampled_from(CoeService), st.integers(0, 0x1FF), st.binary(max_size=20))
def test_message_round_trip(service: CoeService, number: int, body: bytes) -> None:
    header, read = decode_message(encode_message(service, body, number=number))
    assert (header.service, header.number, bytes(read)) == (service, number, body)


@given(st.binary(max_size=12))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, body = decode_message(noise)
    except CodecError:
        return
    assert header.encode() + body == noise


def test_unknown_service_is_malformed() -> None:
    with pytest.raises(MalformedError, match="9 is not a valid CoeService"):
        decode_message(bytes.fromhex("0090"))


def test_pdo_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(CodecError, match="CoeHeader"):
        CoeHeader(0x200, service=CoeService.RX_PDO).encode()


CAPTURED = load("coe_mailbox")
REQUEST, RESPONSE = SdoRequest, SdoResponse
DOWN, UP = REQUEST.DOWNLOAD_SEGMENT, RESPONSE.UPLOAD_SEGMENT


@pytest.mark.parametrize(
    ("data", "complete", "octets"),
    [
        (b"\x11\x22\x33\x44", False, "23 1210 01 11223344"),
        (b"\x11\x22\x33", False, "27 1210 01 11223300"),
        (b"\x11\x22", False, "2b 1210 01 11220000"),
        (b"\x11", False, "2f 1210 01 11000000"),
        (b"12345", False, "21 1210 01 05000000 3132333435"),
        (b"", False, "21 1210 01 00000000"),
        (b"\x11\x22\x33\x44", True, "33 1210 01 11223344"),
        (b"\x11", True, "3f 1210 01 11000000"),
        (b"12345678", True, "31 1210 01 08000000 313233343536"),
    ],
)
def test_download_request(data: bytes, complete: bool, octets: str) -> None:
    sent = encode_initiate(REQUEST.DOWNLOAD, 0x1012, 1, data, complete=complete, max_size=6)
    assert sent == bytes.fromhex(octets)


@pytest.mark.parametrize(
    ("sent", "octets"),
    [
        (encode_plain(REQUEST.UPLOAD, 0x1018, 1), "40 1810 01 00000000"),
        (encode_plain(REQUEST.UPLOAD, 0x1C00, 0, complete=True), "50 001c 00 00000000"),
        (encode_plain(RESPONSE.DOWNLOAD, 0x1018, 1), "60 1810 01 00000000"),
        (encode_initiate(RESPONSE.UPLOAD, 0x1018, 1, b"\x02\0\0\0"), "43 1810 01 02000000"),
        (encode_initiate(RESPONSE.UPLOAD, 0x1018, 1, b"\x02"), "4f 1810 01 02000000"),
        (encode_initiate(RESPONSE.UPLOAD, 0x1008, 0, b"EK1914", max_size=9),
         "41 0810 00 06000000 454b31393134"),
        (encode_segment(DOWN, b"1234567", toggle=0), "00 31323334353637"),
        (encode_segment(DOWN, b"123", toggle=1, last=True), "19 31323300000000"),
        (encode_segment(UP, b"12345678", toggle=1, last=True), "11 3132333435363738"),
        (encode_segment_answer(REQUEST.UPLOAD_SEGMENT, toggle=0), "60 00000000000000"),
        (encode_segment_answer(REQUEST.UPLOAD_SEGMENT, toggle=1), "70 00000000000000"),
        (encode_segment_answer(RESPONSE.DOWNLOAD_SEGMENT, toggle=0), "20 00000000000000"),
        (encode_segment_answer(RESPONSE.DOWNLOAD_SEGMENT, toggle=1), "30 00000000000000"),
        (encode_abort(0x1018, 5, 0x06090011), "0020 80 1810 05 11000906"),
    ],
)  # fmt: skip
def test_message_matches_wire_layout(sent: bytes, octets: str) -> None:
    assert sent == bytes.fromhex(octets)


@pytest.mark.parametrize("vector", CAPTURED, ids=lambda vector: vector.name)
def test_captured_message_encodes_to_the_same_octets(vector: Vector) -> None:
    data = vector.octets[6:]
    header, body = decode_message(data)
    sdo = SdoHeader.decode(body)
    kind: SdoRequest | SdoResponse
    if header.service is CoeService.SDO_REQUEST:
        kind = SdoRequest(sdo.specifier)
    else:
        kind = SdoResponse(sdo.specifier)
    where = (sdo.index, sdo.subindex)
    if sdo.expedited:
        again = encode_initiate(kind, *where, sdo.data, complete=bool(sdo.complete))
    elif sdo.has_size:
        content = bytes(body[SdoHeader.SIZE :])
        assert sdo.value == len(content)
        again = encode_initiate(kind, *where, content, complete=bool(sdo.complete), max_size=999)
    else:
        # EL3004 echoes what was written.
        echoed = SdoHeader(0, 0, 0, sdo.complete, kind, *where, sdo.value).encode()
        again = echoed if sdo.value else encode_plain(kind, *where, complete=bool(sdo.complete))
    assert CoeHeader(service=header.service).encode() + again == data


def test_captured_messages_are_of_every_kind_but_segments() -> None:
    kinds = {(v.octets[7] >> 4, v.octets[8] & 0xF2) for v in CAPTURED}
    assert kinds == {(2, 0x40), (2, 0x50), (2, 0x22), (3, 0x40), (3, 0x50), (3, 0x52), (3, 0x42),
                     (3, 0x60)}  # fmt: skip


def test_expedited_without_size_has_four_octets() -> None:
    head = SdoHeader.decode(bytes.fromhex("4a 1810 01 11223344"))
    assert (head.has_size, head.unused, head.data) == (0, 2, b"\x11\x22\x33\x44")


@given(st.binary(max_size=30), st.integers(0, 1), st.booleans())
def test_segment_round_trip(data: bytes, toggle: int, last: bool) -> None:
    octets = encode_segment(UP, data, toggle=toggle, last=last)
    assert len(octets) >= 8
    head, read = decode_segment(octets)
    assert (head.toggle, head.last, read) == (toggle, last, data)


def test_unused_counts_only_in_the_shortest_segment() -> None:
    assert decode_segment(bytes.fromhex("0f 0102030405060708"))[1] == bytes(range(1, 9))
    assert decode_segment(bytes.fromhex("0f 01020304050607"))[1] == b""
    assert decode_segment(bytes.fromhex("01 0102"))[1] == b"\1\2"


def test_empty_segment_is_truncated() -> None:
    with pytest.raises(TruncatedError, match="SdoSegmentHeader"):
        decode_segment(b"")


def test_abort_vector() -> None:
    assert encode_abort(0x1234, 0, 0x06020000) == load_message("coe_abort")


ENTRY = bytes.fromhex("1810 01 7f 0700 2000 0701 01000000 02000000 00000000 ffffff00") + b"Vendor"


def test_sdo_info_header_matches_wire_layout() -> None:
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


@pytest.mark.parametrize("record", [ObjectDescription, EntryDescription])
@given(noise=st.binary(max_size=40))
def test_garbage_sdo_info_decodes_or_raises_codec_error(record: type, noise: bytes) -> None:
    try:
        read = record.decode(noise)
    except CodecError:
        return
    assert read.index == int.from_bytes(noise[:2], "little")


def test_unknown_opcode_is_malformed() -> None:
    with pytest.raises(MalformedError, match="8 is not a valid SdoInfoOpcode"):
        SdoInfoHeader.decode(bytes.fromhex("08000000"))


@pytest.mark.parametrize(
    ("octets", "text"),
    [
        ("0010", "emergency"),
        ("0020", "SDO request"),
        ("0030", "SDO response"),
        ("0340", "TxPDO 3"),
        ("ff51", "RxPDO 511"),
        ("0060", "TxPDO remote request 0"),
        ("0170", "RxPDO remote request 1"),
        ("0080", "SDO information"),
        ("00f0", "unknown service 15"),
        ("00", ""),
    ],
)
def test_message_is_described_by_service_and_pdo(octets: str, text: str) -> None:
    assert describe_message(bytes.fromhex(octets)) == text
