"""Station of a packet that arrives by a socket of several stations."""

from __future__ import annotations

import pytest

from eap.ams.reassembly import iter_fragments
from eap.ams.routes import Route
from eap.ams.transport_table import Transport
from eap.ids import Endpoint, NetId
from eap.services.transports.demultiplexer import Demultiplexer
from tests.support.ams import ADD_NOTIFICATION, DELETE_NOTIFICATION, NOTIFICATION, Ams
from tests.support.routing import RecordingSender, demultiplexer, station

CLIENT = "192.168.9.9.1.1:33000"
FAR = "7.7.7.7.1.1:851"
HOP = Endpoint("out", "hop")


@pytest.fixture
def sender() -> RecordingSender:
    return RecordingSender()


@pytest.fixture
def stations(sender):
    there = [station(target, name=target) for target in ("1.1.1.1.2.1", "2.2.2.2.2.1")]
    for each in there:
        each.add_transport(Transport("link"), sender)
        each.add_transport(Transport("out"), sender)
    return there


def ask(target: str, **more) -> bytes:
    return Ams(target, CLIENT, **more).octets()


def route(net_id: str, octets: int = 4) -> Route:
    return Route(NetId.parse(net_id), "far", HOP, octets=octets, is_probed=False)


def test_request_goes_to_the_station_that_is_meant(stations, sender):
    way_in = demultiplexer(*stations)
    for target in ("2.2.2.2.2.1:65535", "1.1.1.1.2.1:65535", "9.9.9.9.1.1:1"):
        way_in.receive(ask(target), "peer")
    assert [(name, each.source, each.error) for name, each in sender.sent] == [
        ("peer", "2.2.2.2.2.1:65535", 0),
        ("peer", "1.1.1.1.2.1:65535", 0),
        ("peer", "9.9.9.9.1.1:1", 7),
    ]
    assert [each.record.counts["failed"] for each in stations] == [1, 0]


def test_request_for_others_goes_where_the_best_route_is(stations, sender):
    first, second = stations
    first.add_route(route("0.0.0.0.0.0", octets=0))
    second.add_route(route("7.7.7.7.1.1"))
    way_in = demultiplexer(first, second)
    way_in.receive(ask(FAR), "peer")
    way_in.receive(ask("8.8.8.8.1.1:1"), "peer")
    assert [name for name, _ in sender.sent] == ["hop", "hop"]
    assert [each.stats().in_flight for each in stations] == [1, 1]


def test_answers_and_notifications_go_to_the_requesting_station(stations, sender):
    _, second = stations
    second.add_route(route("7.7.7.7.1.1"))
    demultiplexer(*stations).receive(ask(FAR, command=ADD_NOTIFICATION, body=bytes(40)), "peer")
    (_, asked), *_ = sender.sent
    back = demultiplexer(*stations, transport="out")
    back.receive(asked.answer(bytes(4) + b"\7\0\0\0").octets(), "hop")
    sample = bytes.fromhex("15000000 01000000 0000000000000000 01000000 07000000 01000000 55")
    notice = Ams(CLIENT, FAR, NOTIFICATION, body=sample).octets()
    back.receive(notice, "hop")
    assert [(name, each.command) for name, each in sender.sent[1:]] == [
        ("peer", ADD_NOTIFICATION),
        ("peer", NOTIFICATION),
    ]
    back.receive(notice.replace(b"\7\0\0\0", b"\6\0\0\0"), "hop")
    (ended,) = sender.sent[3:]
    assert (ended[0], ended[1].command) == ("hop", DELETE_NOTIFICATION)


def test_fragments_are_reassembled_before_a_station_is_chosen(stations, sender):
    way_in = demultiplexer(*stations)
    packet = ask("2.2.2.2.2.1:65535", body=b"x" * 100)
    for fragment in iter_fragments(packet, 1, 40):
        way_in.receive(fragment, "peer")
    ((_, answer),) = sender.sent
    assert answer.body.endswith(b"x" * 100)
    *_, last = iter_fragments(packet, 2, 40)
    way_in.receive(last, "peer")
    assert stations[0].record.counts["dropped"] == 1
    first, *_ = iter_fragments(packet, 3, 40)
    waits = bytearray(first)
    waits[18] = 4
    way_in.receive(bytes(waits), "peer")
    assert [each.flags for _, each in sender.sent[1:]] == [5]
    way_in.connection_closed("peer")
    assert len(sender.sent) == 2


def test_multicast_is_answered_by_its_target_only(stations, sender):
    way_in = demultiplexer(*stations)
    way_in.receive(ask("2.2.2.2.2.1:65535"), "peer", is_broadcast=True)
    way_in.receive(ask("9.9.9.9.1.1:1"), "peer", is_broadcast=True)
    assert [each.source for _, each in sender.sent] == ["2.2.2.2.2.1:65535"]


def test_each_station_has_its_own_name_of_the_transport(stations, sender):
    stations[1].remove_transport("link")
    stations[1].add_transport(Transport("other"), sender)
    way_in = Demultiplexer([(stations[0], "link"), (stations[1], "other")])
    way_in.receive(ask("2.2.2.2.2.1:65535"), "peer")
    assert [endpoint.transport for endpoint in stations[1].record.connections.snapshot()] == [
        "other"
    ]


def test_broken_packet_is_remembered_by_the_first(stations, sender):
    demultiplexer(*stations).receive(ask("2.2.2.2.2.1:65535", body=b"xx")[:-1], "peer")
    assert sender.sent == []
    assert [each.record.counts["dropped"] for each in stations] == [1, 0]


def test_hops_are_those_of_all_stations(stations, sender):
    _, second = stations
    second.add_route(route("7.7.7.7.1.1"))
    way_in = demultiplexer(*stations, transport="out")
    assert [way_in.has_route_to(address) for address in ("hop", "other")] == [True, False]
    assert [way_in.has(NetId.parse(each)) for each in ("2.2.2.2.1.1", "7.7.7.7.1.1")] == [
        True,
        False,
    ]
    assert not way_in.is_awaited("hop")
    second.receive(ask(FAR), "link", "peer")
    assert way_in.is_awaited("hop")
    way_in.hop_down("hop", "no cable")
    assert [each.is_down(HOP) for each in stations] == [True, True]
    way_in.hop_up("hop")
    assert [each.is_down(HOP) for each in stations] == [False, False]
    way_in.set_hop_connection("hop", "place")
    second.receive(ask(FAR, invoke_id=2), "link", "peer")
    way_in.receive(sender.sent[-1][1].answer(b"far").octets(), "place")
    assert sender.sent[-1][1].body == b"far"
