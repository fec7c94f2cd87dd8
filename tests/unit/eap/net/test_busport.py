"""The master's end of a bus on UDP, on Ethernet and on a pair."""

from __future__ import annotations

import errno
import select
import socket
import time

import pytest

from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.busport import (
    BusPort,
    SegmentSocket,
    open_bus_port,
    open_bus_socket,
    open_segment,
)
from eap.net.packetsocket import open_type1
from tests.unit.eap.net.conftest import ip, wait_for_links

pytestmark = pytest.mark.net

FRAME = bytes.fromhex("0d10 07 00 0000 0000 0100 0000 00 0000")


def exchange(master, far):
    """Pass a frame to the far end, which answers with one octet changed; return what comes back."""
    assert master.receive() is None
    master.send(FRAME)
    assert select.select([far], [], [], 5)[0]
    arrival = far.receive()
    assert arrival.frame[: len(FRAME)] == FRAME
    arrival.frame[2] = 8
    far.send(arrival.frame, arrival.origin)
    assert select.select([master], [], [], 5)[0]
    return master.receive()


def test_udp():
    far = open_segment(InterfaceUri.parse("udp://127.0.4.9"))
    master = open_bus_port(InterfaceUri.parse("udp://127.0.4.9"))
    try:
        assert exchange(master, far) == FRAME[:2] + b"\x08" + FRAME[3:]
    finally:
        master.close()
        far.close()


@pytest.fixture
def pair():
    near, distant = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ends = BusPort(near), SegmentSocket(distant)
    yield ends
    for end in ends:
        end.close()


def test_pair(pair):
    assert exchange(*pair) == FRAME[:2] + b"\x08" + FRAME[3:]


def test_stamp_is_the_time_of_arrival(pair):
    master, far = pair
    assert master.receive_stamped() is None
    begun_ns = time.monotonic_ns()
    far.send(bytearray(FRAME), b"")
    sent_ns = time.monotonic_ns()
    select.select([], [], [], 0.02)
    frame, at_ns = master.receive_stamped()
    assert frame == FRAME
    # The clock of the host is read beside the monotonic one, and may be corrected meanwhile.
    assert begun_ns - 1_000_000 < at_ns < sent_ns + 10_000_000


def test_tap_of_a_bus_port_sees_what_is_sent_and_received(pair):
    seen = []
    pair[0].tap = lambda frame, is_sent: seen.append((frame, is_sent))
    exchange(*pair)
    assert seen == [(FRAME, True), (FRAME[:2] + b"\x08" + FRAME[3:], False)]
    assert pair[0].receive() is None
    assert len(seen) == 2


def test_bus_port_loses_frames_while_other_end_does_not_read(pair):
    master, far = pair
    for _ in range(2000):
        master.send(FRAME)
    read = sum(1 for _ in iter(far.receive, None))
    assert 0 < read < 2000
    assert exchange(master, far)


def test_empty_message_is_no_frame(pair):
    master, far = pair
    far.send(bytearray(), b"")
    assert master.receive() is None
    master.send(b"")
    assert far.receive() is None


def test_bus_port_without_peer_loses_frame():
    master = open_bus_port(InterfaceUri.parse("udp://127.0.4.9:40002"))
    try:
        for _ in range(3):
            master.send(FRAME)
            assert master.receive() is None
    finally:
        master.close()


@pytest.mark.root
def test_ethernet(cable):
    near, distant = cable
    far = open_segment(InterfaceUri.parse(f"ethernet://{distant}"))
    master = open_bus_port(InterfaceUri.parse(f"ethernet://{near}"))
    try:
        back = exchange(master, far)
        assert back[: len(FRAME)] == FRAME[:2] + b"\x08" + FRAME[3:]
    finally:
        master.close()
        far.close()


class Mirror:
    """A slave end that leaves the source address as it is, or answers somebody else."""

    def __init__(self, interface):
        self._sock = open_type1(interface)

    def fileno(self):
        return self._sock.fileno()

    def answer(self, *, somebody_else=False):
        data = bytearray(self._sock.recv(2048))
        if somebody_else:
            data[6] |= 0x02
            data[11] ^= 0xFF
        self._sock.send(data)

    def close(self):
        self._sock.close()


@pytest.fixture
def mirror(cable):
    near, distant = cable
    ends = open_bus_port(InterfaceUri.parse(f"ethernet://{near}")), Mirror(distant)
    yield ends
    for end in ends:
        end.close()


@pytest.mark.root
def test_bus_port_receives_frames_not_marked_by_slave(mirror):
    master, far = mirror
    master.send(FRAME)
    assert select.select([far], [], [], 5)[0]
    far.answer()
    assert select.select([master], [], [], 5)[0]
    assert master.receive()[: len(FRAME)] == FRAME


@pytest.mark.root
def test_marked_answer_to_another_master_is_not_taken(mirror):
    master, far = mirror
    master.send(FRAME)
    assert select.select([far], [], [], 5)[0]
    far.answer(somebody_else=True)
    assert select.select([master], [], [], 5)[0]
    assert master.receive() is None


@pytest.mark.root
def test_frame_of_another_master_is_not_taken(cable):
    near, distant = cable
    master = open_bus_port(InterfaceUri.parse(f"ethernet://{near}"))
    other = open_bus_port(InterfaceUri.parse(f"ethernet://{distant}"))
    try:
        other.send(FRAME)
        assert select.select([master], [], [], 5)[0]
        assert master.receive() is None
    finally:
        master.close()
        other.close()


@pytest.mark.root
@pytest.mark.parametrize(
    "call", [lambda master: master.send(FRAME), lambda master: master.receive()]
)
def test_interface_that_goes_down(cable, call):
    near, _ = cable
    master = open_bus_port(InterfaceUri.parse(f"ethernet://{near}"))
    try:
        ip(f"link set {near} down")
        with pytest.raises(EnvironmentalError, match="cannot be reached"):
            call(master)
    finally:
        master.close()


def check_interface_made_again(master, near, distant):
    """Make a removed interface again; the next frame fails, and those after it are exchanged."""
    ip(f"link add {near} type veth peer name {distant}")
    for name in (near, distant):
        ip(f"link set {name} up")
    wait_for_links(near, distant)
    far = open_segment(InterfaceUri.parse(f"ethernet://{distant}"))
    try:
        with pytest.raises(EnvironmentalError, match="cannot be reached"):
            master.send(FRAME)
        assert exchange(master, far)[: len(FRAME)] == FRAME[:2] + b"\x08" + FRAME[3:]
    finally:
        far.close()


@pytest.mark.root
def test_interface_that_is_taken_away_and_made_again(cable):
    near, distant = cable
    master = open_bus_port(InterfaceUri.parse(f"ethernet://{near}"))
    try:
        ip(f"link del {near}")
        with pytest.raises(EnvironmentalError, match="cannot be reached"):
            master.receive()
        for _ in range(3):
            with pytest.raises(EnvironmentalError, match="No such device"):
                master.send(FRAME)
        check_interface_made_again(master, near, distant)
    finally:
        master.close()


@pytest.mark.root
def test_interface_that_was_away_when_the_process_began_is_found(cable):
    near, distant = cable
    sock = open_bus_socket(InterfaceUri.parse(f"ethernet://{near}"))
    ip(f"link del {near}")
    master = BusPort(sock, interface=near)
    try:
        with pytest.raises(EnvironmentalError, match="cannot be reached"):
            master.receive()
        check_interface_made_again(master, near, distant)
    finally:
        master.close()


@pytest.mark.parametrize("text", ["tcp://127.0.0.1", "loop://x", "ethernet://nothere"])
def test_interface_that_is_no_bus(text):
    with pytest.raises(EnvironmentalError, match=r"a bus is reached by|no interface"):
        open_bus_port(InterfaceUri.parse(text))


def test_ethernet_without_the_capability(monkeypatch):
    def refuse(*arguments):
        raise PermissionError

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr("eap.net.packetsocket.check_interface", lambda name: None)
    with pytest.raises(EnvironmentalError, match="CAP_NET_RAW"):
        open_bus_port(InterfaceUri.parse("ethernet://lo"))


MASTER = bytes.fromhex("010105010000 00112233445588a4".replace(" ", ""))


def open_udp(text="udp://127.0.9.8"):
    return open_segment(InterfaceUri.parse(text))


def wait(sock):
    assert select.select([sock], [], [], 5)[0]


def test_udp_frame_goes_back_to_its_sender():
    end = open_udp()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as master:
            master.settimeout(5)
            assert end.receive() is None
            master.sendto(FRAME, ("127.0.9.8", 34980))
            wait(end)
            arrival = end.receive()
            assert arrival.frame == FRAME
            arrival.frame[2] = 8
            end.send(arrival.frame, arrival.origin)
            assert master.recv(100) == FRAME[:2] + b"\x08" + FRAME[3:]
    finally:
        end.close()


def test_segment_socket_ignores_closed_sender():
    end = open_udp("udp://127.0.9.8:40001")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as master:
            master.bind(("127.0.0.1", 0))
            origin = master.getsockname()
        for _ in range(3):
            end.send(bytearray(FRAME), origin)
            assert end.receive() is None
    finally:
        end.close()


def test_port_that_is_taken():
    end = open_udp()
    try:
        with pytest.raises(EnvironmentalError, match=r"127\.0\.9\.8"):
            open_udp()
    finally:
        end.close()


def test_segment_socket_ignores_closed_pair():
    near, distant = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    end = SegmentSocket(near)
    try:
        distant.send(FRAME)
        assert end.receive() == (FRAME, b"")
        distant.close()
        end.send(bytearray(FRAME), b"")
        assert end.receive() is None
    finally:
        end.close()


@pytest.mark.parametrize("text", ["tcp://127.0.0.1", "loop://x"])
def test_interface_that_is_no_segments(text):
    with pytest.raises(EnvironmentalError, match="a segment answers on"):
        open_udp(text)


@pytest.mark.root
def test_ethernet_frame_goes_back_marked_and_padded(cable):
    left, right = cable
    end = open_segment(InterfaceUri.parse(f"ethernet://{right}"))
    try:
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4)) as master:
            master.settimeout(5)
            master.bind((left, 0x88A4))
            master.send(MASTER + FRAME)
            wait(end)
            arrival = end.receive()
            assert arrival.frame[: len(FRAME)] == FRAME
            end.send(arrival.frame, arrival.origin)
            back = master.recv(100)
            assert (back[6], back[14 : 14 + len(FRAME)], len(back)) == (
                0x02,
                FRAME,
                60,
            )
            assert end.receive() is None  # what goes out does not come in
    finally:
        end.close()


@pytest.mark.root
def test_ethernet_interface_that_is_not_there():
    with pytest.raises(EnvironmentalError, match="nowhere"):
        open_segment(InterfaceUri.parse("ethernet://nowhere"))


def test_segment_socket_survives_errors_of_its_interface():
    class Broken:
        family = socket.AF_INET

        def setblocking(self, flag):
            pass

        def recvfrom(self, size):
            raise OSError(errno.ENETDOWN, "Network is down")

        def sendto(self, *_):
            raise OSError(errno.ENETDOWN, "Network is down")

    sock = SegmentSocket(Broken())
    assert sock.receive() is None
    sock.send(bytearray(60), ("127.0.0.1", 1))
