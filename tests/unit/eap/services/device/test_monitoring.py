"""Subscriber monitoring on images and sockets of the test; time is an argument."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import time
from ipaddress import IPv4Address

import msgspec
import pytest

from eap.codec.arp import ETHERTYPE_ARP, REPLY, ArpMessage
from eap.errors import ImageError
from eap.ids import MacAddr
from eap.net.neighbour import ArpProber, NeighbourTable
from eap.net.packetsocket import open_arp
from eap.pd.address import to_word
from eap.pd.image import Image
from eap.pd.report import frame_status
from eap.pd.spec import TxFrameSpec, TxPdSpec
from eap.pd.words import FrameWord
from eap.runtime.handover import PortName
from eap.services.device.monitoring import (
    POLL_NS,
    SubscriberProbes,
    SubscriberWatch,
    UdpSubscriberProbe,
)
from tests.support.cyclic import image_of, station, written
from tests.support.eventually import eventually, settle
from tests.unit.eap.net.conftest import cable as _cable

pytestmark = pytest.mark.net

cable = _cable
SECOND = 1_000_000_000
PORT = PortName("a", "eap0")
NOBODY = "02:00:00:00:00:09"


class Holder:
    """The image of one station, which the test may replace; without one there is none just now."""

    def __init__(self, *frames: TxFrameSpec) -> None:
        self.current: Image | None = None
        self.replace(*frames)

    def replace(self, *frames: TxFrameSpec) -> None:
        image = image_of(station("a", variables=written("x:UINT"), frames=frames))
        for spec, place in zip(frames, image.layout.frames, strict=True):
            image.words[place.words + FrameWord.ADDRESS] = to_word(spec.destination)
        self.current = image

    @property
    def image(self) -> Image:
        if self.current is None:
            raise ImageError("there is none")
        return self.current

    def put(self, word: FrameWord, value: int) -> None:
        self.image.words[self.image.layout.frames[0].words + word] = value

    def status(self, number: int = 0) -> str:
        return frame_status(self.image, self.image.layout.frames[number])["subscriber"]

    def state(self) -> int:
        return frame_status(self.image, self.image.layout.frames[0])["frame_state"]


def frame(destination: str, name: str = "f", **more: object) -> TxFrameSpec:
    more.setdefault("monitor_interval_ms", 1000)
    return TxFrameSpec(name, "eap0", destination, (TxPdSpec(f"{name}-pd", 1, ("x",)),), **more)


@pytest.fixture
def endpoint():
    table = NeighbourTable()
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.9.2.8", 0))
    endpoint = UdpSubscriberProbe([sock], table, "127.9.2.8")
    yield endpoint
    endpoint.close()
    table.close()


@pytest.fixture
def closed():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.9.2.9", 0))
        return "{}:{}".format(*sock.getsockname())


def send(endpoint, holder, target, now_ns):
    host, _, port = target.partition(":")
    endpoint.sockets[0].sendto(b"frame", (host, int(port)))
    holder.put(FrameWord.SENT_AT_NS, now_ns)


def test_a_refused_frame_has_no_subscriber(endpoint, closed, caplog):
    holder = Holder(frame(closed))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    watch.step(SECOND)
    assert (holder.status(), holder.state()) == ("unknown", 0)
    send(endpoint, holder, closed, 2 * SECOND)
    watch.step(2 * SECOND)
    assert (holder.status(), holder.state()) == ("missing", 4)
    assert f"a/f: subscriber at {closed} is missing" in caplog.text


def test_a_listener_on_this_machine_is_unknown_never_present(endpoint, closed, caplog):
    caplog.set_level(logging.INFO)
    holder = Holder(frame(closed))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    watch.step(SECOND)
    send(endpoint, holder, closed, 2 * SECOND)
    watch.step(2 * SECOND)
    found = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        host, _, port = closed.partition(":")
        listener.bind((host, int(port)))
        for second in range(3, 20):
            send(endpoint, holder, closed, second * SECOND)
            watch.step(second * SECOND)
            found.add(holder.status())
    assert holder.status() == "unknown"
    assert found == {"missing", "unknown"}
    assert "is no longer observable" in caplog.text


@pytest.mark.parametrize(
    "destination", ["239.1.1.1", "tcp://10.0.0.1", "5.5.5.5.1.1", NOBODY, "01:01:05:04:00:00"]
)
def test_subscriber_without_evidence_is_unknown(endpoint, destination):
    holder = Holder(frame(destination))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    for second in range(1, 10):
        watch.step(second * SECOND)
    assert holder.status() == "unknown"


def test_frame_with_a_new_destination_is_monitored_again(endpoint, closed):
    holder = Holder(frame(closed))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    watch.step(SECOND)
    send(endpoint, holder, closed, 2 * SECOND)
    watch.step(2 * SECOND)
    assert holder.status() == "missing"
    holder.put(FrameWord.ADDRESS, to_word("127.9.2.7"))
    watch.step(2 * SECOND + 1)
    assert holder.status() == "unknown"


def test_watch_follows_a_new_configuration(endpoint, closed):
    holder = Holder(frame(closed), frame("127.9.2.7", "g"))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    watch.step(SECOND)
    holder.current = None
    watch.step(2 * SECOND)
    holder.replace(frame("127.9.2.7", "g"), frame(closed, "h", monitor_interval_ms=0))
    watch.step(3 * SECOND)
    send(endpoint, holder, closed, 4 * SECOND)
    watch.step(4 * SECOND)
    assert (holder.status(0), holder.status(1)) == ("unknown", "unknown")


def test_evidence_of_an_unchanged_frame_is_kept(endpoint, closed):
    holder = Holder(frame(closed))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))
    watch.step(SECOND)
    send(endpoint, holder, closed, 2 * SECOND)
    watch.step(2 * SECOND)
    holder.replace(frame("127.9.2.7", "g"), frame(closed))
    watch.step(2 * SECOND + 1)
    assert (holder.status(0), holder.status(1)) == ("unknown", "missing")


def test_watch_without_frames_polls_the_images(endpoint):
    watch = SubscriberWatch({"a": Holder()}, SubscriberProbes({}, {PORT: endpoint}))
    assert watch.step(SECOND) == SECOND + POLL_NS


def test_errors_are_taken_as_they_come(endpoint, closed):
    holder = Holder(frame(closed))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({}, {PORT: endpoint}))

    async def scenario() -> float:
        task = asyncio.get_running_loop().create_task(watch.run())
        await settle()
        # What the engine receives is none of its business and wakes nobody.
        endpoint.sockets[0].sendto(b"frame", endpoint.sockets[0].getsockname())
        started = time.monotonic()
        send(endpoint, holder, closed, time.monotonic_ns())
        await eventually(lambda: holder.status() == "missing")
        took = time.monotonic() - started
        task.cancel()
        await asyncio.wait([task])
        return took

    async def bounded() -> float:
        return await asyncio.wait_for(scenario(), 5)

    assert asyncio.run(bounded()) < 2
    assert endpoint.sockets[0].recv(10) == b"frame"


class Host:
    """Host at the other end of a cable that answers for one address or not."""

    def __init__(self, interface: str) -> None:
        self.sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE_ARP))
        self.sock.bind((interface, ETHERTYPE_ARP))
        self.sock.settimeout(2)
        self.mac = MacAddr(self.sock.getsockname()[4])

    def answer(self) -> None:
        asked = ArpMessage.decode(self.sock.recv(100), 14)
        reply = ArpMessage(REPLY, self.mac, asked.target, asked.sender_mac, asked.sender)
        head = asked.sender_mac + self.mac + struct.pack("!H", ETHERTYPE_ARP)
        self.sock.send(head + reply.encode())


@pytest.fixture
def ends(cable):
    """A prober at one end of a cable, and a host at the other."""
    hop_prober, host = ArpProber(open_arp(cable[0])), Host(cable[1])
    yield hop_prober, host
    hop_prober.close()
    host.sock.close()


@pytest.mark.root
def test_arp_detects_present_and_missing_subscribers(ends):
    hop_prober, host = ends
    holder = Holder(frame(str(host.mac), monitor_ip="10.77.0.2"))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({PORT: hop_prober}, {}))
    watch.step(SECOND)
    host.answer()
    watch.step(SECOND + POLL_NS)
    assert (holder.status(), holder.state()) == ("present", 0)
    for half in range(3, 12):
        watch.step(half * SECOND // 2)
    assert (holder.status(), holder.state()) == ("missing", 4)


@pytest.mark.root
def test_another_host_with_the_address_is_not_the_subscriber(ends, caplog):
    hop_prober, host = ends
    holder = Holder(frame(NOBODY, monitor_ip="10.77.0.2"))
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({PORT: hop_prober}, {}))
    for half in range(2, 12):
        watch.step(half * SECOND // 2)
        if not half % 2:
            host.answer()
    assert holder.status() == "missing"
    assert f"10.77.0.2 is answered by {host.mac} instead" in caplog.text


@pytest.mark.root
def test_too_many_addresses_for_a_socket_are_logged(ends, caplog):
    hop_prober, _ = ends
    frames = [
        frame(NOBODY, f"f{n}", monitor_ip=str(IPv4Address(0x0A4D0000 + n))) for n in range(1001)
    ]
    holder = Holder(*frames)
    watch = SubscriberWatch({"a": holder}, SubscriberProbes({PORT: hop_prober}, {}))
    watch.step(SECOND)
    assert "1001 addresses to monitor on one interface" in caplog.text
    holder.replace(msgspec.structs.replace(frames[0], destination=NOBODY))
    watch.step(2 * SECOND)
    assert holder.status() == "unknown"
