"""The capture driver on a veth pair: what it sees, and that it disturbs nobody."""

from __future__ import annotations

import contextlib
import socket
import time

import pytest

from eap.net.capture import FrameCapture
from tests.support.eventually import wait_until
from tests.support.packets import ethernet, tcp_segment, udp
from tests.unit.eap.net.conftest import ip, wait_for_links

pytestmark = [pytest.mark.net, pytest.mark.root]

FRAME = bytes.fromhex("1540 c0a800010101 0100 0100 0000 e903 0000 0100 0000 01")


@pytest.fixture
def capture(cable):
    with contextlib.closing(FrameCapture("right")) as found:
        yield found


@pytest.fixture
def left(cable):
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as sock:
        sock.bind(("left", 0))
        yield sock


def captured(capture, count):
    found = []
    limit = time.monotonic() + 5
    while len(found) < count:
        assert time.monotonic() < limit, found
        capture.drain(lambda octets, at_ns, tci: found.append((bytes(octets), at_ns, tci)))
    return found


def test_capture_sees_ethercat_and_udp_and_nothing_else(capture, left):
    sent = [
        ethernet(FRAME),
        ethernet(FRAME, vlan=0xE007),
        udp(FRAME),
        udp(FRAME, port=40_000),
        udp(FRAME, source_port=40_000),
        udp(b"last"),
    ]
    for other in (
        udp(FRAME, source_port=1, port=2),
        tcp_segment(FRAME, 1),
        ethernet(b"", ethertype=0x0806),
    ):
        left.send(other)
    for octets in sent:
        left.send(octets)
    found = captured(capture, len(sent))
    # The kernel takes the tag of a received packet out and gives it beside the packet.
    assert [octets for octets, _, _ in found] == [
        ethernet(FRAME),
        ethernet(FRAME)[:56],
        *sent[2:],
    ]
    assert [tci for _, _, tci in found] == [0, 0xE007, 0, 0, 0, 0]
    assert capture.dropped == 0


def test_capture_sees_what_its_own_host_sends_once(capture):
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as right:
        right.bind(("right", 0))
        for octets in (ethernet(FRAME, vlan=5), udp(FRAME)):
            right.send(octets)
    found = captured(capture, 2)
    assert [octets for octets, _, _ in found] == [ethernet(FRAME, vlan=5), udp(FRAME)]


def test_capture_of_loopback_has_each_packet_once():
    """Each time among packets of others, for loopback is everybody's."""
    source = "127.9.5.1"
    mine = []

    def take(octets, at_ns, tci):
        if octets[26:30] == socket.inet_aton(source) and octets[42:] == FRAME:
            mine.append(at_ns)

    with (
        contextlib.closing(FrameCapture("lo")) as capture,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock,
    ):
        sock.bind((source, 0))
        for _ in range(2):
            sock.sendto(FRAME, ("127.9.5.2", 34980))
        before_ns = time.monotonic_ns()
        wait_until(lambda: capture.drain(take) >= 0 and len(mine) >= 2)
        capture.drain(take)
        assert len(mine) == 2
        assert all(0 <= before_ns - at_ns < 60e9 for at_ns in mine)


def test_capture_counts_what_it_could_not_keep(capture, left):
    capture._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    for _ in range(500):
        left.send(udp(bytes(1000)))
    assert capture.dropped > 0
    assert capture.dropped > 0  # the kernel's own counter starts again with each reading


def test_capture_outlives_an_interface_that_goes_down(capture, left):
    ip("link set right down")
    ip("link set right up")
    wait_for_links("left", "right")
    left.send(udp(FRAME))
    assert len(captured(capture, 1)) == 1
    assert capture.errors == {"ENETDOWN": 1}


def test_fragments_but_the_first_are_left_out(capture, left):
    for offset in (0x2000, 0x0001):  # more follow; behind the first
        octets = bytearray(udp(FRAME))
        octets[20:22] = offset.to_bytes(2)
        left.send(octets)
    left.send(udp(b"end"))
    assert len(captured(capture, 2)) == 2
