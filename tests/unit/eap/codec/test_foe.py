from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.foe import (
    Busy,
    FoeErrorCode,
    FoeHeader,
    FoeOpcode,
    decode_message,
    encode_message,
    name_of,
    text_of,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.vectors import load_message


@pytest.mark.parametrize(
    ("octets", "sent"),
    [
        ("01 00 78563412 66772e62696e", (FoeOpcode.READ, 0x12345678, b"fw.bin")),
        ("03 00 01000000 0102", (FoeOpcode.DATA, 1, b"\1\2")),
        ("04 00 00000000", (FoeOpcode.ACK, 0)),
        ("05 00 05800000", (FoeOpcode.ERROR, FoeErrorCode.PACKET_NUMBER)),
        ("06 00 0a006400 7761697421", (FoeOpcode.BUSY, Busy(10, 100).number, b"wait!")),
    ],
)
def test_message_matches_wire_layout(octets: str, sent: tuple) -> None:
    assert encode_message(*sent) == bytes.fromhex(octets)


@given(st.sampled_from(FoeOpcode), st.integers(0, 0xFFFFFFFF), st.binary(max_size=20), st.data())
def test_round_trip_and_every_short_prefix_is_truncated(
    opcode: FoeOpcode, number: int, body: bytes, data: st.DataObject
) -> None:
    octets = encode_message(opcode, number, body)
    header, read = decode_message(octets)
    assert (header, bytes(read)) == (FoeHeader(opcode, number=number), body)
    with pytest.raises(TruncatedError, match="FoeHeader"):
        decode_message(octets[: data.draw(st.integers(0, FoeHeader.SIZE - 1))])


@given(st.binary(max_size=20))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, body = decode_message(noise)
    except CodecError:
        return
    assert header.encode() + body == noise


def test_unknown_opcode_is_malformed() -> None:
    with pytest.raises(MalformedError, match="7 is not a valid FoeOpcode"):
        decode_message(bytes.fromhex("070000000000"))


@given(st.integers(0, 0xFFFFFFFF))
def test_busy_is_two_words(number: int) -> None:
    busy = Busy.of(number)
    assert busy.number == number
    assert max(busy) <= 0xFFFF


def test_every_error_code_has_a_text_of_its_own() -> None:
    assert [code.value for code in FoeErrorCode] == list(range(0x8000, 0x800D))
    assert len({name_of(code) for code in FoeErrorCode}) == len(FoeErrorCode)
    assert name_of(0x8008) == "only in state BOOT"
    assert name_of(0x9000) == "error code of the vendor"


@pytest.mark.parametrize(
    ("octets", "text"),
    [(b"fw.bin", "fw.bin"), (b"fw.bin\0\0", "fw.bin"), (b"", ""), (b"\xff", "�")],
)
def test_trailing_nuls_are_no_part_of_a_text(octets: bytes, text: str) -> None:
    assert text_of(octets) == text


@pytest.mark.parametrize(
    ("name", "opcode", "number", "body"),
    [
        ("foe_rrq", FoeOpcode.READ, 0, b"firmware.bin"),
        ("foe_data1", FoeOpcode.DATA, 1, b"hello"),
        ("foe_busy", FoeOpcode.BUSY, Busy(3, 10).number, b"wait"),
        ("foe_err", FoeOpcode.ERROR, FoeErrorCode.NOT_FOUND, b"not found"),
    ],
)
def test_vector(name: str, opcode: FoeOpcode, number: int, body: bytes) -> None:
    octets = load_message(name)
    header, read = decode_message(octets)
    assert (header.opcode, header.number, bytes(read)) == (opcode, number, body)
    assert encode_message(opcode, number, body) == octets
