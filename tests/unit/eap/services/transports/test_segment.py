"""Stations on an Ethernet segment: by MAC address, by NetID, and on this host."""

from __future__ import annotations

import asyncio

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.hop_prober import PROBE_PORT
from eap.ams.routes import Route
from eap.ams.transport_table import Transport
from eap.codec.ams import AmsCommand
from eap.ids import EAP_MULTICAST_MAC, MacAddr, NetId
from eap.services.transports import mailbox_frames as segment_module
from eap.services.transports.mailbox_frames import EthernetSegment, SegmentSender
from tests.support import aoe
from tests.support.ams import Ams, parse
from tests.support.routing import demultiplexer, station

OWN, PEER, OTHER = "02:00:00:00:00:01", "02:00:00:00:00:02", "02:00:00:00:00:03"
HERE, THERE = "1.1.1.1.2.1", "2.2.2.2.2.1"
CLIENT = f"{aoe.CLIENT}:33000"


class Wire:
    """A channel that keeps what it is to send."""

    minimum_size = 0

    def __init__(self) -> None:
        self.sent: list[tuple[str, Ams]] = []

    def link_header(self, destination):
        return b""

    def send(self, frames, now_ns):
        self.sent += [(each.destination, parse(aoe.opened(bytes(each.buffer)))) for each in frames]
        return ()


class Scene:
    """A station on a segment, with a route to another by the NetID of its port."""

    def __init__(self, *others) -> None:
        self.station = station(HERE)
        self.wire = Wire()
        self.segment = EthernetSegment(
            demultiplexer(self.station, *others, transport="ethernet:eap0"), MacAddr.parse(OWN)
        )
        for each in (self.station, *others):
            sender = SegmentSender(self.segment, self.wire, each.net_id)
            each.add_transport(Transport("ethernet:eap0"), sender)
        endpoint = Endpoint("ethernet:eap0", THERE)
        self.station.add_route(Route(NetId.parse(THERE), "there", endpoint, is_probed=False))
        self.station.add_transport(Transport("ams-tcp", is_stream=True), self)
        self.replies: list[Ams] = []

    def send(self, connection, packets):
        """Take what goes back by the door that requests come in by."""
        self.replies += [parse(packet) for packet in packets]

    def answer(self, mac: str, net_id: str = THERE, port: int = PROBE_PORT, flags: int = 5) -> None:
        packet = Ams(f"{self.station.net_id}:{port}", f"{net_id}:65535", 4, flags)
        self.segment.receive(packet.octets(), mac)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def forward(scene: Scene, invoke_id: int = 1) -> list[tuple[str, Ams]]:
    """Ask from another door; return what goes out."""
    scene.wire.sent.clear()
    scene.replies = []
    packet = Ams(f"{THERE}:65535", CLIENT, invoke_id=invoke_id).octets()
    scene.station.receive(packet, "ams-tcp", "127.0.0.1:1#1")
    return scene.wire.sent


def test_segment_queries_and_learns_the_mac_address_of_a_net_id(scene):
    ((where, question),) = forward(scene)
    assert where == str(EAP_MULTICAST_MAC)
    assert (question.target, question.command) == (f"{THERE}:65535", AmsCommand.READ_STATE)
    assert question.source == f"{scene.station.net_id}:{PROBE_PORT}"
    assert [each.error for each in scene.replies] == [0x1B]
    scene.answer(PEER)
    ((where, request),) = forward(scene, 2)
    assert (where, request.target) == (PEER, f"{THERE}:65535")
    scene.segment.receive(request.answer(b"far").octets(), PEER)
    assert [each.body for each in scene.replies] == [b"far"]


@pytest.mark.parametrize(
    "more", [{"net_id": "3.3.3.3.1.1"}, {"port": 300}, {"flags": 4}], ids=["who", "whom", "what"]
)
def test_segment_learns_from_answers_to_its_query_only(scene, more):
    forward(scene)
    scene.answer(OTHER, **more)
    assert [where for where, _ in forward(scene, 2) if where == OTHER] == []


def test_broken_packet_teaches_nothing(scene):
    forward(scene)
    scene.segment.receive(b"short", PEER)
    assert scene.station.record.counts["dropped"] == 1


def test_segment_repeats_its_query(scene, monkeypatch):
    now = [10**12]
    monkeypatch.setattr(segment_module, "monotonic_ns", lambda: now[0])
    assert len(forward(scene, 1)) == 1
    assert len(forward(scene, 2)) == 0
    now[0] += segment_module.QUERY_NS
    assert len(forward(scene, 3)) == 1
    scene.answer(PEER)
    assert [where for where, _ in forward(scene, 4)] == [PEER]
    now[0] += segment_module.QUERY_KNOWN_NS
    assert [where for where, _ in forward(scene, 5)] == [str(EAP_MULTICAST_MAC), PEER]
    scene.answer(OTHER)
    assert [where for where, _ in forward(scene, 6)] == [OTHER]


def test_stations_of_this_host_need_no_wire():
    neighbour = station(THERE)
    scene = Scene(neighbour)

    async def script():
        forward(scene)
        while not scene.replies:  # noqa: ASYNC110
            await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(script(), 1))
    assert scene.wire.sent == []
    assert [(each.error, each.body) for each in scene.replies] == [(0, bytes(4) + b"\2")]


def test_answers_go_to_the_mac_address_that_asked(scene):
    scene.segment.receive(Ams(f"{HERE}:65535", CLIENT).octets(), PEER)
    assert [where for where, _ in scene.wire.sent] == [PEER]
