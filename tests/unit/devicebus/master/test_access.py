from __future__ import annotations

from devicebus.master import access
from devicebus.master.access import DatagramRequest
from devicebus.wire.datagram import Command


def test_positions_count_down_on_their_way():
    assert access.aprd(0, 0x10, 2) == DatagramRequest(Command.APRD, 0, 0x10, b"\0\0")
    assert access.apwr(2, 0x10, b"ab") == DatagramRequest(Command.APWR, 0xFFFE, 0x10, b"ab")


def test_stations_and_broadcasts():
    assert access.fprd(1001, 0x130, 2, tries=1) == DatagramRequest(
        Command.FPRD, 1001, 0x130, b"\0\0", 1
    )
    assert access.fpwr(1001, 0x120, b"\1\0") == DatagramRequest(
        Command.FPWR, 1001, 0x120, b"\1\0", 0
    )
    assert access.brd(0, 1) == DatagramRequest(Command.BRD, 0, 0, b"\0")
    assert access.bwr(0x120, b"\1") == DatagramRequest(Command.BWR, 0, 0x120, b"\1")


def test_what_ages_is_sent_once():
    assert access.frmw(1001, 0x910, 8) == DatagramRequest(Command.FRMW, 1001, 0x910, bytes(8), 1)
    assert access.logical(Command.LRW, 0x12345678, b"x") == DatagramRequest(
        Command.LRW, 0x5678, 0x1234, b"x", 1
    )
