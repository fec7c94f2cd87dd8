"""A port with datagrams and connections: each frame goes the way its destination asks for."""

from __future__ import annotations

import socket
import time

import pytest

from eap.ids import InterfaceUri
from eap.net import tcpport
from eap.net.ipsocket import open_tcp_listener
from eap.net.limits import CloseReason, ListenerLimits
from eap.net.loopback import LoopbackLines
from eap.net.tcp import TcpReceiver
from eap.net.tcpport import TcpPort
from eap.pd.link import OutFrame
from tests.support.appliance import wait_until

pytestmark = pytest.mark.net

HERE, THERE = "127.0.3.22", "127.0.3.23"
TCP = f"tcp://{THERE}"
SECOND = 1_000_000_000


class Listener:
    def __init__(self):
        self.got = []
        self.take = self._take  # one object, as the handlers of a station are

    def _take(self, data, size, _at_ns, _origin):
        self.got.append(bytes(data[:size]))


def frame(number, destination):
    return OutFrame(bytearray([1, 0x40, number]), 0, destination)


@pytest.fixture
def plant():
    """A port with a line beside it, and the far port with a connection from the first."""
    lines = LoopbackLines()
    line, far_line = (lines.open(InterfaceUri.parse("loop://line")) for _ in range(2))
    heard = Listener()
    far_line.handlers.append(heard.take)
    near, far = TcpPort(HERE, line), TcpPort(THERE, far_line)
    with open_tcp_listener(THERE) as listener:
        listener.settimeout(5)
        assert near.link_header(TCP) == near.link_header(TCP) == b""
        near.drain(0)
        taken = Listener()
        receiver = TcpReceiver(listener.accept()[0], [taken.take])
        assert far.accept(receiver, 0, spare_descriptors=9)
        near.drain(0)
        yield near, far, heard, taken
    near.close()
    far.close()


def drain_until(port, done):
    limit = time.monotonic() + 5
    while not done():
        assert time.monotonic() < limit
        port.drain(0)


def test_each_frame_goes_its_way(plant):
    near, far, heard, taken = plant
    frames = [frame(1, TCP), frame(2, "127.0.3.24"), frame(3, TCP)]
    assert list(near.send(frames, 0)) == []
    drain_until(far, lambda: len(taken.got) == 2)
    assert taken.got == [b"\x01\x40\x01", b"\x01\x40\x03"]
    assert heard.got == [b"\x01\x40\x02"]
    assert near.errors == {}


def test_exchanged_handlers_take_datagrams_connections_and_answers(plant):
    near, far, heard, taken = plant
    answers, tap, answered = Listener(), Listener(), Listener()
    near.follow({TCP}, [answers.take])
    far.exchange_handler(heard.take, tap.take)
    far.exchange_handler(taken.take, tap.take)
    near.send([frame(1, TCP), frame(2, "127.0.3.24")], 0)
    drain_until(far, lambda: len(tap.got) == 2)
    assert heard.got == taken.got == []
    near.drain(0)  # its connection listens for answers from now on
    near.exchange_handler(answers.take, answered.take)
    (receiver,) = far._receivers
    assert far.send([frame(3, receiver.name)], 0) == []
    drain_until(near, lambda: answered.got)
    assert (answered.got, answers.got) == ([b"\x01\x40\x03"], [])


def test_frames_that_find_no_connection_are_returned_and_counted():
    port = TcpPort(HERE)
    port.link_header(TCP)
    frames = [frame(1, TCP), frame(2, "127.0.3.24")]
    assert list(port.send(frames, 0)) == frames
    assert port.errors == {"not_connected": 1}
    assert port.drain(0) == 0
    port.close()


def test_connection_that_ends_is_counted_under_its_reason_and_forgotten(plant):
    near, far, _, _ = plant
    near.close()
    drain_until(far, lambda: far.closed)
    far.drain(0)
    assert far.closed == {"closed by the peer": 1}


def test_port_needs_no_headroom():
    port = TcpPort(HERE)
    assert port.link_header("127.0.3.24") == b""
    assert port.minimum_size == 0
    assert port.drain(0) == 0


def test_tcp_port_answer_returns_to_requester():
    answers, requests = Listener(), Listener()
    near, far = TcpPort(HERE, None, [answers.take]), TcpPort(THERE)
    with open_tcp_listener(THERE) as listener:
        listener.settimeout(5)
        near.link_header(TCP)
        near.drain(0)
        accepted = [TcpReceiver(listener.accept()[0], [requests.take])]
        far.accept(accepted[0], 0, spare_descriptors=9)
        drain_until(near, lambda: near.send([frame(1, TCP)], 0) == [])
        drain_until(far, lambda: requests.got)
        back = accepted[0].name
        assert far.link_header(back) == b""
        assert far.send([frame(2, back), frame(3, back)], 0) == []
        drain_until(near, lambda: len(answers.got) == 2)
        assert answers.got == [b"\x01\x40\x02", b"\x01\x40\x03"]
    near.close()
    drain_until(far, lambda: far.closed)
    late = frame(4, back)
    assert far.send([late], 0) == [late]
    assert far.errors == {"not_connected": 1}
    far.close()


def test_tcp_port_returns_and_counts_unsent_answers(plant):
    near, far, _, taken = plant
    near.send([frame(1, TCP)], 0)
    drain_until(far, lambda: taken.got)
    name = far._receivers[0].name
    large = OutFrame(bytearray(2000), 0, name)
    failed = [each for _ in range(4000) for each in far.send([large], 0)]
    assert failed[-1] is large
    assert far.errors == {"slow_peer": len(failed)}


def test_port_evicts_unused_connections_and_closes_unfinished_ones(monkeypatch):
    monkeypatch.setattr(tcpport, "LIMITS", ListenerLimits(total=2, reserved=0))
    port, peers = TcpPort(HERE), []

    def connect(host, now_ns):
        peers.append(socket.create_connection(listener.getsockname(), 5))
        receiver = TcpReceiver(listener.accept()[0], [], host=host)
        is_taken = port.accept(receiver, now_ns, spare_descriptors=9)
        if not is_taken:
            receiver.close()
        return is_taken

    with socket.create_server(("127.0.0.1", 0)) as listener:
        assert connect("10.0.0.2", SECOND)
        assert connect("10.0.0.2", SECOND)
        peers[0].sendall(b"\x01\x40\x07")
        wait_until(lambda: port.drain(SECOND))
        assert connect("10.0.0.3", 2 * SECOND)
        assert peers[1].recv(1) == b""
        peers[2].sendall(b"\x05\x40x")
        wait_until(lambda: port.drain(3 * SECOND) or port._receivers[1].late_since_ns)
        assert not connect("10.0.0.2", 4 * SECOND)
        port.drain(13 * SECOND)
        port.drain(14 * SECOND)
    assert port.closed == {CloseReason.EVICTED: 1, CloseReason.OVERDUE: 1}
    assert peers[2].recv(1) == b""
    assert port.connections == 1
    for peer in peers:
        peer.close()
    port.close()
