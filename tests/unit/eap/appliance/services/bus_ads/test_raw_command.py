"""EtherCAT commands of clients: datagrams with headers and working counters."""

from __future__ import annotations

import pytest

from devicebus.master.access import Access, Reply, brd
from devicebus.wire.datagram import Command
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.services.bus_ads.raw_command import RawCommands
from eap.codec.ads import AdsError

COUNT = bytes.fromhex("01ff 0000 0000 0400 0000 00000000 0000")
WRITE = bytes.fromhex("0507 e903 2001 0200 0000 0800 0000")


def test_commands_and_answers():
    commands = RawCommands(COUNT + WRITE)
    assert commands.accesses() == [
        brd(0, 1),
        Access(Command.APRD, 0, 0, bytes(4), 1),
        Access(Command.FPWR, 1001, 0x120, b"\x08\0", 1),
    ]
    replies = [Reply(b"\0", 3), Reply(b"\x11\0\2\0", 1), Reply(b"\x08\0", 1)]
    assert commands.encode_answer(replies) == (
        bytes.fromhex("01ff 0300 0000 0400 0000 11000200 0100")
        + bytes.fromhex("0507 e903 2001 0200 0000 0800 0100")
    )


def test_position_counts_past_zero():
    last = RawCommands(COUNT[:2] + b"\xfe\xff" + COUNT[4:])
    assert last.encode_answer([Reply(b"\0", 3), Reply(bytes(4), 1)])[2:4] == b"\1\0"


@pytest.mark.parametrize(
    ("data", "result"),
    [
        (b"", AdsError.SIZE),
        (COUNT[:9], AdsError.SIZE),
        (COUNT[:-1], AdsError.SIZE),
        (COUNT + b"\1", AdsError.SIZE),
        (b"\x63" + COUNT[1:], AdsError.VALUE),
    ],
)
def test_what_is_no_command(data, result):
    with pytest.raises(AdsRefusedError) as refused:
        RawCommands(data)
    assert refused.value.result == result
