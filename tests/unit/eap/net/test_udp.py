"""The UDP channel: what it hands over, to whom, and how much at once."""

from __future__ import annotations

import contextlib
import select
import socket
from functools import partial

import pytest

from eap.net.ipsocket import open_udp_pair
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import (
    UdpChannel,
    UdpError,
    _destination,
    _socket_address,
    enable_errors,
    read_errors,
)
from eap.pd.link import OutFrame

pytestmark = pytest.mark.net


@pytest.fixture
def channels():
    """Two engine channels that share one batch."""
    batch = ReceiveBatch()
    with contextlib.ExitStack() as stack:
        found = []
        for host in ("127.0.3.12", "127.0.3.13"):
            engine, services = open_udp_pair(host)
            stack.callback(services.close)
            found.append(UdpChannel(engine, batch))
            stack.callback(found[-1].close)
        yield found


def process_data(number):
    return OutFrame(bytearray([number, 0x40, number]), 0, "127.0.3.13")


def test_frames_reach_the_only_taker(channels):
    sender, receiver = channels
    got = []
    receiver.handlers.append(lambda view, size, _at, _origin: got.append(bytes(view[:size])))
    assert sender.send([process_data(n) for n in range(3)], 0) == ()
    assert receiver.drain(0) == 3
    assert got == [bytes([n, 0x40, n]) for n in range(3)]
    assert receiver.drain(0) == 0
    assert sender.errors == receiver.errors == {}


def test_every_taker_of_a_shared_socket_gets_every_frame(channels):
    sender, receiver = channels
    got = []
    receiver.handlers += [
        lambda view, _size, _at, _origin: got.append(("a", view[0])),
        lambda view, _size, _at, _origin: got.append(("b", view[0])),
    ]
    sender.send([process_data(5), process_data(6)], 0)
    assert receiver.drain(0) == 2
    assert got == [("a", 5), ("b", 5), ("a", 6), ("b", 6)]


def test_drain_is_bounded(channels):
    sender, receiver = channels
    got = []
    receiver.handlers.append(lambda view, _size, _at, _origin: got.append(view[0]))
    frame = process_data(1)
    for _ in range(300):
        sender.send((frame,), 0)
    assert receiver.drain(0) == 256
    assert receiver.drain(0) == 44
    assert len(got) == 300


def test_error_about_a_frame_sent_does_not_keep_one_that_waits(channels):
    sender, receiver = channels
    got = []
    receiver.handlers.append(lambda view, size, *_: got.append(bytes(view[:size])))
    enable_errors(receiver._sock)
    sender.send([process_data(4)], 0)
    receiver.send([OutFrame(bytearray(3), 0, "127.0.3.14:9")], 0)
    assert receiver.drain(0) == 1
    assert got == [bytes([4, 0x40, 4])]
    assert receiver.errors == {}


def test_unreachable_destination_is_counted_not_raised(channels):
    sender, _ = channels
    frame = OutFrame(bytearray(3), 0, "0.0.0.1")
    assert sender.send([frame], 0) == [frame]
    assert sum(sender.errors.values()) == 1


def test_broken_socket_is_counted_not_raised(channels):
    sender, receiver = channels
    receiver._receive = receiver._batch.reader(-1)
    drains = [partial(UdpChannel.drain, receiver)]
    if drain := receiver._batch.compiled_socket(-1, receiver.handlers, receiver, None):
        drains.append(drain)
    for number, drain in enumerate(drains, 1):
        assert drain(0) == 0
        assert receiver.errors == {"EBADF": number}
    assert sender.fileno() != receiver.fileno()


def test_datagrams_need_no_headroom(channels):
    assert channels[0].link_header("127.0.3.13") == b""
    assert channels[0].minimum_size == 0


def test_destination_without_a_port_goes_to_the_usual_one():
    packed, address = _socket_address("127.0.3.13")
    assert address == ("127.0.3.13", 34980)
    assert packed[2:] == b"\x88\xa4\x7f\x00\x03\x0d" + bytes(8)
    assert _socket_address("127.0.3.13:9")[1] == ("127.0.3.13", 9)


def test_udp_answer_goes_to_address_and_port_of_requester(channels):
    server, _ = channels
    senders, sources = [], []
    server.handlers.append(lambda view, _size, _at, origin: senders.append(origin.sender_of(view)))
    server.handlers.append(lambda view, _size, _at, origin: sources.append(origin.source_of(view)))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5)
        client.bind(("127.0.3.14", 0))
        for count in (1, 2):
            for _ in range(count):
                client.sendto(b"\x01\x40\x01", server._sock.getsockname())
            assert server.drain(0) == count
        host, port = client.getsockname()
        assert senders == [f"{host}:{port}"] * 3
        assert sources == [bytes((127, 0, 3, 14))] * 3
        server.send([OutFrame(bytearray(b"\x01\x40\x02"), 0, senders[0])], 0)
        assert client.recv(10) == b"\x01\x40\x02"


@pytest.mark.parametrize(
    ("host", "port", "destination"),
    [("10.0.0.1", 34980, "10.0.0.1:34980"), ("10.0.0.1", 0, "10.0.0.1"), ("0.0.0.0", 9, "")],
)
def test_udp_sender_without_address_or_port(host, port, destination):
    assert _destination((port, socket.inet_aton(host))) == destination


pytestmark = pytest.mark.net


@pytest.fixture
def sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        enable_errors(sock)
        yield sock


@pytest.fixture
def closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.77.2", 0))
        return sock.getsockname()


def test_udp_error_without_listener(sender, closed_port):
    sender.sendto(b"frame", closed_port)
    select.select([], [], [sender], 1)
    expected = UdpError(*closed_port, True, "ECONNREFUSED")
    assert read_errors(sender) == [expected]
    assert read_errors(sender) == []


def test_udp_reading_last_error_clears_pending_error(sender, closed_port):
    sender.sendto(b"frame", closed_port)
    read_errors(sender)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        sender.sendto(b"frame", listener.getsockname())
        assert listener.recv(10) == b"frame"


def test_some_are_left_for_the_next_time(sender, closed_port):
    for _ in range(3):
        sender.sendto(b"frame", closed_port)
        sender.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)  # or the next would be refused
    assert [len(read_errors(sender, 2)) for _ in range(3)] == [2, 1, 0]


def test_udp_error_too_large_is_not_unreachable(sender):
    sender.setsockopt(socket.IPPROTO_IP, 10, 2)  # IP_MTU_DISCOVER, IP_PMTUDISC_DO
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="too long"):
            sender.sendto(bytes(65507 + 1), listener.getsockname())
        assert all(not error.unreachable for error in read_errors(sender))


def test_udp_errors_are_queued_only_if_enabled(closed_port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.sendto(b"frame", closed_port)
        assert read_errors(sock) == []
