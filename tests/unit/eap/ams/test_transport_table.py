from __future__ import annotations

import pytest

from eap.ams.reassembly import FragmentAssembler
from eap.ams.record import Outcome
from eap.ams.transport_table import Forward, Reply, Transport, TransportTable
from eap.codec.ams import decode_packet
from eap.ids import Endpoint
from tests.support.ams import Ams


def test_outcomes_have_the_names_that_people_read() -> None:
    assert sorted(Outcome) == [
        "answered", "denied", "dropped", "failed", "interrupted", "late", "loop", "restored",
    ]  # fmt: skip


PACKET = Ams("5.1.1.1.1.1:851", "6.1.1.1.1.1:3000", body=bytes(range(100))).octets()
WIDE, NARROW = Endpoint("tcp", "1"), Endpoint("box", "1")


def test_transport_table_sends_short_packet_whole() -> None:
    transports = TransportTable([Transport("tcp"), Transport("box", max_size=132)])
    assert transports.reply(WIDE, PACKET) == Reply(WIDE, (PACKET,))
    assert transports.forward(NARROW, PACKET, 7) == Forward(NARROW, (PACKET,), 7)


def test_transport_table_sends_long_packet_in_fragments() -> None:
    transports = TransportTable([Transport("box", max_size=60)])
    for _ in range(2):
        assembler = FragmentAssembler()
        pieces = transports.reply(NARROW, PACKET).packets
        assert max(map(len, pieces)) == 60
        taken = [assembler.receive(*_read(each), 0).packet for each in pieces]
        assert taken[-1] == PACKET
        assert not any(taken[:-1])


def test_packets_have_numbers_of_their_own() -> None:
    transports = TransportTable([Transport("box", max_size=60)])
    first, second = (transports.reply(NARROW, PACKET).packets[0] for _ in range(2))
    assert first != second


def test_transport_table_matches_endpoints_of_a_hop() -> None:
    transports = TransportTable(
        [Transport("tcp"), Transport("segment"), Transport("broker", is_shared=True)]
    )
    assert transports.is_from(Endpoint("tcp", "1"), Endpoint("tcp", "1"))
    assert not transports.is_from(Endpoint("tcp", "1"), Endpoint("tcp", "2"))
    assert transports.is_from(Endpoint("broker", "1"), Endpoint("broker", "2"))
    assert not transports.is_from(Endpoint("broker", "1"), Endpoint("tcp", "1"))
    named = Endpoint("segment", "1.2.3.4.5.6")
    assert not transports.is_from(named, Endpoint("segment", "02:00:00:00:00:01"))
    transports.set_connection(named, "02:00:00:00:00:01")
    assert transports.is_from(named, Endpoint("segment", "02:00:00:00:00:01"))
    assert not transports.is_from(named, Endpoint("tcp", "02:00:00:00:00:01"))


def test_transport_table_refuses_invalid_transports() -> None:
    with pytest.raises(ValueError, match="'a' exists already"):
        TransportTable([Transport("a"), Transport("a")])
    with pytest.raises(ValueError, match="expected more than 32"):
        TransportTable([Transport("a", max_size=32)])


def _read(packet: bytes) -> tuple:
    header, body = decode_packet(packet)
    return header, bytes(body)
