from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.wire import datagram
from devicebus.wire.datagram import (
    OVERHEAD,
    Command,
    Datagram,
    DatagramHeader,
    DatagramRequest,
    encode_frame,
    iter_datagrams,
)
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.wirerecords import records

datagrams = st.lists(
    st.builds(Datagram, records(DatagramHeader), st.binary(max_size=40), st.integers(0, 0xFFFF)),
    min_size=1,
    max_size=15,
)
STATE = DatagramHeader(Command.FPRD, 206, 0x03E9, 0x0130, 0)


def test_datagram_lies_as_on_the_wire() -> None:
    first = Datagram(STATE, b"\x02\x00", 1)
    logical = Datagram(DatagramHeader(Command.LRW, 1, 0x5678, 0x1234, 0, irq=4), b"", 3)
    assert encode_frame([first, logical]).hex(" ") == (
        "1a 10 04 ce e9 03 30 01 02 80 00 00 02 00 01 00 0c 01 78 56 34 12 00 00 04 00 03 00"
    )
    assert logical.header.logical_address == 0x12345678


def test_logical_commands_are_the_three_of_the_standard() -> None:
    assert [c.name for c in Command if c.is_logical] == ["LRD", "LWR", "LRW"]


@given(datagrams)
def test_round_trip(items: list[Datagram]) -> None:
    frame = encode_frame(items)
    assert len(frame) == 2 + sum(OVERHEAD + len(item.data) for item in items)
    read = list(iter_datagrams(frame + b"padding"))
    assert [(bytes(d.data), d.wkc) for d in read] == [(bytes(d.data), d.wkc) for d in items]
    assert [d.header.more for d in read] == [1] * (len(items) - 1) + [0]
    assert encode_frame(read) == frame


@given(datagrams, st.data())
def test_every_prefix_is_truncated(items: list[Datagram], data: st.DataObject) -> None:
    frame = encode_frame(items)
    cut = data.draw(st.integers(0, len(frame) - 1))
    with pytest.raises(TruncatedError):
        list(iter_datagrams(frame[:cut]))


@given(st.binary(max_size=80), st.booleans())
def test_garbage_decodes_or_raises_codec_error(noise: bytes, as_type_1: bool) -> None:
    if as_type_1:
        noise = EtherCatHeader(len(noise), type=FrameType.DATAGRAM).encode() + noise
    try:
        read = list(iter_datagrams(noise))
    except CodecError:
        return
    assert encode_frame(read)[2:] == noise[2 : len(encode_frame(read))]


def test_more_without_a_next_datagram_is_truncated_after_the_good_one() -> None:
    frame = bytearray(encode_frame([Datagram(STATE, b"\x02", 1)]))
    frame[9] |= 0x80
    read = iter_datagrams(frame)
    assert next(read).wkc == 1
    with pytest.raises(TruncatedError, match="DatagramHeader at offset 15"):
        next(read)


def test_hostile_length_is_truncated() -> None:
    frame = bytearray(encode_frame([Datagram(STATE, b"\x02", 1)]))
    frame[8] = 0xFF
    with pytest.raises(TruncatedError, match="WorkingCounter"):
        next(iter_datagrams(frame))


def test_unknown_command_is_malformed() -> None:
    frame = bytearray(encode_frame([Datagram(STATE, b"", 0)]))
    frame[2] = 15
    with pytest.raises(MalformedError, match="15 is not a valid Command"):
        next(iter_datagrams(frame))


def test_other_frame_type_is_malformed() -> None:
    with pytest.raises(MalformedError, match="frame type 4, expected 1"):
        next(iter_datagrams(EtherCatHeader(12).encode() + bytes(12)))


@pytest.mark.parametrize("items", [[], [Datagram(STATE, bytes(2036), 0)]], ids=["none", "long"])
def test_frame_that_cannot_be_is_refused(items: list[Datagram]) -> None:
    with pytest.raises(CodecError):
        encode_frame(items)


def test_datagram_positions_count_down():
    assert datagram.aprd(0, 0x10, 2) == DatagramRequest(Command.APRD, 0, 0x10, b"\0\0")
    assert datagram.apwr(2, 0x10, b"ab") == DatagramRequest(Command.APWR, 0xFFFE, 0x10, b"ab")


def test_stations_and_broadcasts():
    assert datagram.fprd(1001, 0x130, 2, tries=1) == DatagramRequest(
        Command.FPRD, 1001, 0x130, b"\0\0", 1
    )
    assert datagram.fpwr(1001, 0x120, b"\1\0") == DatagramRequest(
        Command.FPWR, 1001, 0x120, b"\1\0", 0
    )
    assert datagram.brd(0, 1) == DatagramRequest(Command.BRD, 0, 0, b"\0")
    assert datagram.bwr(0x120, b"\1") == DatagramRequest(Command.BWR, 0, 0x120, b"\1")


def test_datagram_of_a_time_is_sent_once():
    assert datagram.frmw(1001, 0x910, 8) == DatagramRequest(Command.FRMW, 1001, 0x910, bytes(8), 1)
    assert datagram.logical(Command.LRW, 0x12345678, b"x") == DatagramRequest(
        Command.LRW, 0x5678, 0x1234, b"x", 1
    )
