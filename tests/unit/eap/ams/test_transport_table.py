from __future__ import annotations

import pytest

from eap.ams.action import Forward, Reply
from eap.ams.endpoint import Door, Way
from eap.ams.fragment import Assembler
from eap.ams.transport_table import Outlet
from eap.codec.ams import decode_packet
from tests.support.ams import Ams

PACKET = Ams("5.1.1.1.1.1:851", "6.1.1.1.1.1:3000", body=bytes(range(100))).octets()
WIDE, NARROW = Way("tcp", "1"), Way("box", "1")


def test_packet_goes_in_one_piece_where_there_is_room() -> None:
    outlet = Outlet([Door("tcp"), Door("box", room=132)])
    assert outlet.reply(WIDE, PACKET) == Reply(WIDE, (PACKET,))
    assert outlet.forward(NARROW, PACKET, 7) == Forward(NARROW, (PACKET,), 7)


def test_packet_is_cut_where_there_is_not() -> None:
    outlet = Outlet([Door("box", room=60)])
    for _ in range(2):
        assembler = Assembler()
        pieces = outlet.reply(NARROW, PACKET).packets
        assert max(map(len, pieces)) == 60
        taken = [assembler.receive(*_read(each), 0).packet for each in pieces]
        assert taken[-1] == PACKET
        assert not any(taken[:-1])


def test_packets_have_numbers_of_their_own() -> None:
    outlet = Outlet([Door("box", room=60)])
    first, second = (outlet.reply(NARROW, PACKET).packets[0] for _ in range(2))
    assert first != second


def test_what_comes_from_a_hop() -> None:
    outlet = Outlet([Door("tcp"), Door("segment"), Door("broker", is_shared=True)])
    assert outlet.is_from(Way("tcp", "1"), Way("tcp", "1"))
    assert not outlet.is_from(Way("tcp", "1"), Way("tcp", "2"))
    assert outlet.is_from(Way("broker", "1"), Way("broker", "2"))
    assert not outlet.is_from(Way("broker", "1"), Way("tcp", "1"))
    named = Way("segment", "1.2.3.4.5.6")
    assert not outlet.is_from(named, Way("segment", "02:00:00:00:00:01"))
    outlet.note_place(named, "02:00:00:00:00:01")
    assert outlet.is_from(named, Way("segment", "02:00:00:00:00:01"))
    assert not outlet.is_from(named, Way("tcp", "02:00:00:00:00:01"))


def test_doors_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="two doors 'a'"):
        Outlet([Door("a"), Door("a")])
    with pytest.raises(ValueError, match="expected more than 32"):
        Outlet([Door("a", room=32)])


def _read(packet: bytes) -> tuple:
    header, body = decode_packet(packet)
    return header, bytes(body)
