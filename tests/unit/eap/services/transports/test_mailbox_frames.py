"""Frames of type 5: intake, framing, and MAC addresses of NetIDs."""

from __future__ import annotations

import asyncio
import select
import socket
import time
from time import monotonic_ns

import pytest

from eap.ams.hop_prober import PROBE_PORT
from eap.ams.routes import Route
from eap.ams.transport_table import Transport
from eap.codec.ams import AmsCommand
from eap.codec.ethercat import EtherCatHeader
from eap.ids import EAP_MULTICAST_MAC, Endpoint, MacAddr, NetId
from eap.net.busypoll import BusyPollLoop
from eap.net.ipsocket import prepare_receiver
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.runtime.drop_counters import DropCounters, DropReason
from eap.services.transports import mailbox_frames
from eap.services.transports.mailbox_frames import (
    EthernetSegment,
    FrameCounters,
    FrameIntake,
    SegmentSender,
    aoe_packet,
    refusal_of,
    watch_channel,
)
from tests.support import aoe
from tests.support.ams import Ams, parse
from tests.support.cyclic import From
from tests.support.eventually import eventually
from tests.support.routing import demultiplexer, station

PACKET = aoe.packet("1.1.1.1.2.1", 4, b"abc")


@pytest.mark.parametrize("frame", [aoe.frame(PACKET), aoe.frame(PACKET, counter=0) + bytes(9)])
def test_aoe_packet_accepts_aoe_to_address_0(frame):
    assert aoe_packet(frame) == PACKET


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (aoe.frame(PACKET, address=1001), DropReason.MAILBOX),
        (aoe.frame(PACKET, kind=3), DropReason.MAILBOX),
        (aoe.frame(PACKET, kind=9), DropReason.MAILBOX),
        (aoe.frame(PACKET)[:-1], DropReason.TRUNCATED),
        (aoe.frame(b"too short"), DropReason.MAILBOX),
        (b"\x00\x50", DropReason.TRUNCATED),
    ],
)
def test_aoe_packet_rejects_other_frames(frame, reason):
    assert aoe_packet(frame) is None
    assert refusal_of(frame) is reason


def test_each_peer_gets_its_own_counter(monkeypatch):
    monkeypatch.setattr(mailbox_frames, "_MAX_PEERS", 2)
    counters = FrameCounters()
    peers = ["a"] * 8 + ["b", "a", "c", "a", "b"]
    frames = [counters.frame(peer, PACKET) for peer in peers]
    assert [each[7] >> 4 for each in frames] == [1, 2, 3, 4, 5, 6, 7, 1, 1, 2, 1, 3, 1]
    assert {aoe.opened(each) for each in frames} == {PACKET}


MAILBOX = memoryview(EtherCatHeader(6, 0, 5).encode() + bytes(6))
NOBODY = From()
UNKNOWN = memoryview(EtherCatHeader(0, 0, 7).encode())


@pytest.fixture
def counters(tmp_path):
    with DropCounters(tmp_path / "discards", ["a", "b"]) as counters:
        yield counters


def refuse(data, size, at_ns, origin) -> DropReason | None:
    return DropReason.MAILBOX


def test_each_frame_is_counted_once_at_every_station(counters):
    intake = FrameIntake(["a", "b"], counters, 100, refuse)
    intake.receive(MAILBOX, 8, 99, NOBODY)
    intake.receive(MAILBOX, 8, 100, NOBODY)
    intake.receive(MAILBOX, 8, 101, NOBODY)
    intake.receive(UNKNOWN, 2, 100, NOBODY)
    intake.receive(UNKNOWN, 1, 100, NOBODY)
    expected = {"mailbox": 2, "stale": 1, "wrong_type": 1, "truncated": 1}
    assert counters.stats() == {"a": expected, "b": expected}


def test_accepted_frame_is_not_counted(counters):
    taken = []
    intake = FrameIntake(["a", "b"], counters, 100, lambda *frame: taken.append(frame))
    intake.receive(MAILBOX, 8, 99, NOBODY)
    intake.receive(MAILBOX, 8, 100, NOBODY)
    intake.receive(UNKNOWN, 2, 100, NOBODY)
    assert taken == [(MAILBOX, 8, 100, NOBODY)]
    assert counters.stats()["a"] == {"stale": 1, "wrong_type": 1}


@pytest.mark.net
@pytest.mark.parametrize("make_loop", [BusyPollLoop, asyncio.new_event_loop])
def test_a_socket_is_drained_at_once_and_on_arrival(counters, make_loop):
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        prepare_receiver(receiver)
        time.sleep(0.1)  # the first one on a machine that asks: the kernel begins to stamp later
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        sender.send(MAILBOX)
        assert select.select([receiver], [], [], 5)[0]  # a busy kernel delivers later

        async def serve():
            # The kernel stamps on another clock, and the two are compared to microseconds only.
            await asyncio.sleep(0.01)
            intake = FrameIntake(["a"], counters, monotonic_ns(), refuse)
            watch_channel(UdpChannel(receiver, ReceiveBatch(), [intake.receive]))
            assert counters.stats()["a"] == {"stale": 1}
            sender.send(MAILBOX)
            await eventually(lambda: "mailbox" in counters.stats()["a"])

        with asyncio.Runner(loop_factory=make_loop) as runner:
            runner.run(serve())
    assert counters.stats()["a"] == {"stale": 1, "mailbox": 1}


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
        self.own = MacAddr.parse(OWN)
        self.segment = EthernetSegment(
            demultiplexer(self.station, *others, transport="ethernet:eap0"), lambda: self.own
        )
        for each in (self.station, *others):
            sender = SegmentSender(self.segment, self.wire, each.net_id)
            each.add_transport(Transport("ethernet:eap0"), sender)
        endpoint = Endpoint("ethernet:eap0", THERE)
        self.station.add_route(Route(NetId.parse(THERE), "there", endpoint, is_probed=False))
        self.station.add_transport(Transport("ams-tcp", is_stream=True), self)
        self.replies: list[Ams] = []

    def send(self, connection, packets):
        """Take what goes back by the transport that requests come in by."""
        self.replies += [parse(packet) for packet in packets]

    def answer(self, mac: str, net_id: str = THERE, port: int = PROBE_PORT, flags: int = 5) -> None:
        packet = Ams(f"{self.station.net_id}:{port}", f"{net_id}:65535", 4, flags)
        self.segment.receive(packet.octets(), mac)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def forward(scene: Scene, invoke_id: int = 1) -> list[tuple[str, Ams]]:
    """Ask from another transport; return what goes out."""
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
    monkeypatch.setattr(mailbox_frames, "monotonic_ns", lambda: now[0])
    assert len(forward(scene, 1)) == 1
    assert len(forward(scene, 2)) == 0
    now[0] += mailbox_frames.QUERY_NS
    assert len(forward(scene, 3)) == 1
    scene.answer(PEER)
    assert [where for where, _ in forward(scene, 4)] == [PEER]
    now[0] += mailbox_frames.QUERY_KNOWN_NS
    assert [where for where, _ in forward(scene, 5)] == [str(EAP_MULTICAST_MAC), PEER]
    scene.answer(OTHER)
    assert [where for where, _ in forward(scene, 6)] == [OTHER]


def test_segment_forgets_addresses_with_its_interface(scene):
    forward(scene)
    scene.answer(PEER)
    assert [where for where, _ in forward(scene, 2)] == [PEER]
    scene.own = MacAddr.parse(OTHER)
    scene.segment.forget()
    assert next(where for where, _ in forward(scene, 3)) == str(EAP_MULTICAST_MAC)
    assert scene.segment.mac == OTHER


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
