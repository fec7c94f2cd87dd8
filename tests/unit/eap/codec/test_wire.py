from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.wire.datagram import DatagramHeader, WorkingCounter
from eap.codec.ams import AmsHeader
from eap.codec.ethercat import EtherCatHeader
from eap.codec.mailbox import MailboxErrorReply, MailboxHeader
from eap.codec.pd import PdFrameHeader, PdHeader
from eap.codec.wire import Bits, Scalar, WireStruct, bit, bits3, bits4, net_id, u8, u16, u32, u64
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId
from tests.support.wirerecords import records


class Colour(IntEnum):
    RED = 1
    BLUE = 3


class Mixed(WireStruct, frozen=True):
    """Every kind of field: scalars around two words of bits, wrapped and plain."""

    first: u8
    colour: Annotated[Colour, Bits(4, Colour)]
    flag: bit
    small: bits3
    owner: net_id
    kind: Annotated[Colour, Scalar("B", Colour)]
    middle: u16 = 0
    large: u32 = 0
    huge: u64 = 0
    low: bits4 = 0
    high: bits4 = 0


OWNER = NetId.parse("1.2.3.4.5.6")
ALL = [
    Mixed,
    EtherCatHeader,
    PdFrameHeader,
    PdHeader,
    MailboxHeader,
    MailboxErrorReply,
    AmsHeader,
    DatagramHeader,
    WorkingCounter,
]
any_record = st.sampled_from(ALL).flatmap(records)


def mixed(**changes: object) -> Mixed:
    values: dict = {
        "first": 1,
        "colour": Colour.RED,
        "flag": 1,
        "small": 5,
        "owner": OWNER,
        "kind": Colour.BLUE,
    }
    return Mixed(**(values | changes))


def test_fields_lie_where_declared() -> None:
    octets = mixed(middle=0x1234, large=0x89ABCDEF, huge=7, low=2, high=15).encode()
    assert octets.hex(" ") == (
        "01 b1 01 02 03 04 05 06 03 34 12 ef cd ab 89 07 00 00 00 00 00 00 00 f2"
    )
    assert len(octets) == Mixed.SIZE == Mixed.LAYOUT.size


def test_wrapped_fields_have_their_type() -> None:
    record = Mixed.decode(mixed().encode())
    assert record.owner == OWNER
    assert [type(record.owner), type(record.colour), type(record.kind)] == [NetId, Colour, Colour]


def test_decode_starts_at_the_offset_and_ignores_the_rest() -> None:
    assert PdHeader.decode(b"\xff" + PdHeader(1, 2, 3, 4).encode() + b"\xff", 1) == PdHeader(
        1, 2, 3, 4
    )


@given(any_record, st.binary(max_size=3), st.sampled_from((bytes, bytearray, memoryview)))
def test_record_survives_its_bytes(record: WireStruct, before: bytes, form: type) -> None:
    octets = record.encode()
    assert len(octets) == record.SIZE
    assert type(record).decode(form(before + octets), len(before)) == record


@given(any_record, st.data())
def test_every_prefix_is_truncated(record: WireStruct, data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, record.SIZE - 1))
    with pytest.raises(TruncatedError, match=type(record).__name__) as caught:
        type(record).decode(record.encode()[:cut])
    assert caught.value.layout == type(record).__name__


@given(st.sampled_from(ALL), st.binary(max_size=40), st.integers(0, 50))
def test_garbage_decodes_or_raises_codec_error(
    record: type[WireStruct], noise: bytes, offset: int
) -> None:
    try:
        decoded = record.decode(noise, offset)
    except CodecError:
        return
    assert decoded.encode() == noise[offset : offset + record.SIZE]


@pytest.mark.parametrize(("position", "octet"), [(1, 0xB2), (8, 2)])
def test_unknown_enum_value_is_malformed(position: int, octet: int) -> None:
    octets = bytearray(mixed().encode())
    octets[position] = octet
    with pytest.raises(MalformedError, match="2 is not a valid Colour"):
        Mixed.decode(octets)


@pytest.mark.parametrize(
    "changes",
    [
        {"first": 256},
        {"first": -1},
        {"middle": 0x10000},
        {"large": 1 << 32},
        {"huge": 1 << 64},
        {"low": 16},
        {"high": -1},
        {"flag": 2},
        {"small": 8},
        {"owner": b"12345"},
        {"owner": b"1234567"},
        {"owner": "1.2.3.4.5.6"},
        {"middle": 1.5},
        {"small": None},
    ],
    ids=str,
)
def test_value_that_does_not_fit_is_refused(changes: dict) -> None:
    with pytest.raises(CodecError, match=f"Mixed.*{next(iter(changes))}="):
        mixed(**changes).encode()


def test_bits_that_fill_no_word_are_a_programming_error() -> None:
    with pytest.raises(TypeError, match="Odd: bit fields stop at bit 3"):

        class Odd(WireStruct, frozen=True):
            lonely: bits3
            octet: u8


def test_records_are_values() -> None:
    assert {mixed(), mixed()} == {mixed()}
    with pytest.raises(AttributeError):
        mixed().first = 2
