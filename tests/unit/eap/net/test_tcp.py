"""Type 4 over TCP: connecting, whole frames only, and peers that misbehave."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from itertools import pairwise

import pytest

from eap.errors import EnvironmentalError
from eap.net.ipsocket import open_tcp_listener
from eap.net.tcp import CONNECTION, FRAMES_PER_DRAIN, TcpReceiver, TcpSender, TcpWriter
from eap.pd.link import OutFrame

pytestmark = pytest.mark.net

MS = 1_000_000
HERE, THERE = "127.0.3.20", "127.0.3.21"
DESTINATION = f"tcp://{THERE}"


def frame_octets(number, size=20):
    return struct.pack("<H", 0x4000 | size) + bytes([number]) * size


def out_frame(number, size=20):
    return OutFrame(bytearray(frame_octets(number, size)), 0, DESTINATION)


@pytest.fixture
def listener():
    with open_tcp_listener(THERE) as sock:
        sock.settimeout(5)
        yield sock


@pytest.fixture
def sender():
    made = TcpSender(DESTINATION, HERE, {})
    yield made
    made.close()


@pytest.fixture
def joined(listener, sender):
    """A connected sender and the plain socket at the other end."""
    sender.poll(0)
    connection, address = listener.accept()
    with connection:
        assert address[0] == HERE
        until(sender, lambda: sender.connected)
        yield sender, connection


@pytest.fixture
def receiving():
    """A plain socket and the receiver at its other end, with what that took."""
    got = []
    near, far = socket.socketpair()
    with near, open_tcp_listener(HERE) as server:
        far.close()
        with socket.create_connection((HERE, 34980)) as client:
            accepted, _ = server.accept()
            receiver = TcpReceiver(
                accepted,
                [lambda data, size, at_ns, _origin: got.append((bytes(data[:size]), at_ns))],
            )
            yield client, receiver, got
            receiver.close()


def until(sender, done, *, now_ns=0):
    """Poll until the kernel has done its part."""
    limit = time.monotonic() + 5
    while not done():
        assert time.monotonic() < limit
        sender.poll(now_ns)


def read(connection, size):
    connection.settimeout(5)
    data = b""
    while len(data) < size:
        data += connection.recv(size - len(data))
    return data


def drain_until(receiver, got, count):
    limit = time.monotonic() + 5
    while len(got) < count and not receiver.closed:
        assert time.monotonic() < limit
        receiver.drain(7)


def test_frames_follow_each_other_on_the_stream(joined):
    sender, connection = joined
    assert all(sender.send(out_frame(n), 0) for n in range(3))
    assert read(connection, 66) == b"".join(frame_octets(n) for n in range(3))
    assert sender._errors == {}


def test_without_a_connection_frames_are_lost_and_counted(sender):
    assert not sender.send(out_frame(1), 0)
    assert sender._errors == {"not_connected": 1}


def test_refused_connection_is_tried_again_ever_more_slowly(sender):
    attempts, now_ms = [], 0
    while len(attempts) < 8:
        sender.poll(now_ms * MS)
        failures = sender._errors.get("ECONNREFUSED", 0)
        if sender._sock is None and failures > len(attempts):
            attempts.append(now_ms)
        elif sender._sock is not None:
            until(sender, lambda: sender._sock is None, now_ns=now_ms * MS)
            attempts.append(now_ms)
        now_ms += 1
    gaps = [later - earlier for earlier, later in pairwise(attempts)]
    assert gaps == [100, 200, 400, 800, 1600, 2000, 2000]


def test_tcp_sender_connects_once_peer_listens(sender):
    until(sender, lambda: sender._errors)
    with open_tcp_listener(THERE) as listener:
        sender.poll(99 * MS)
        assert not sender.connected
        until(sender, lambda: sender.connected, now_ns=100 * MS)
        listener.accept()[0].close()


def test_slow_peer_loses_whole_frames_and_gets_begun_ones_whole(joined):
    sender, connection = joined
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sent = []
    number = 0
    while sender._errors.get("slow_peer", 0) < 5:
        if sender.send(out_frame(number % 250, size=2000), 0):
            sent.append(number % 250)
        number += 1
    expected = b"".join(frame_octets(n, 2000) for n in sent)
    received = b""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)  # no longer slow
    connection.setblocking(False)
    limit = time.monotonic() + 30
    while len(received) < len(expected) and time.monotonic() < limit:
        with contextlib.suppress(BlockingIOError):
            received += connection.recv(65536)
        sender.poll(0)
    assert received == expected
    assert sender.send(out_frame(1), 0)
    assert read(connection, 22) == frame_octets(1)


def test_peer_that_leaves_is_noticed_and_sought_again(joined, listener):
    sender, connection = joined
    connection.close()
    until(sender, lambda: not sender.connected)
    assert sender._errors == {"ECONNRESET": 1}
    assert not sender.send(out_frame(1), 0)
    until(sender, lambda: sender.connected, now_ns=100 * MS)
    listener.accept()[0].close()


def test_tcp_sender_without_handlers_drops_received_data(joined):
    sender, connection = joined
    connection.sendall(b"x" * 5000)
    for _ in range(10):
        sender.poll(0)
    assert sender.connected
    assert sender.send(out_frame(1), 0)


def test_reset_in_the_middle_is_counted(joined):
    sender, connection = joined
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    limit = time.monotonic() + 5
    while sender.send(out_frame(1), 0):
        assert time.monotonic() < limit
    assert not sender.connected
    assert set(sender._errors) <= {"ECONNRESET", "EPIPE"}


def test_address_that_is_not_ours_is_counted():
    errors = {}
    sender = TcpSender(DESTINATION, "203.0.113.9", errors)
    sender.poll(0)
    assert errors == {"EADDRNOTAVAIL": 1}


def test_attempt_that_gets_no_answer_is_given_up():
    with contextlib.ExitStack() as stack:
        full = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
        full.bind((THERE, 0))
        full.listen(0)
        for _ in range(2):  # fill the queue, so that a further attempt hangs
            filler = stack.enter_context(socket.socket())
            filler.setblocking(False)
            filler.connect_ex(full.getsockname())
        sender = TcpSender(f"{DESTINATION}:{full.getsockname()[1]}", HERE, {})
        stack.callback(sender.close)
        sender.poll(0)
        sender.poll(999 * MS)
        assert sender._errors == {}
        sender.poll(1000 * MS)
        assert sender._errors == {"ETIMEDOUT": 1}


@pytest.mark.parametrize("pieces", [1, 2, 3, 7, 100])
def test_frames_are_put_together_from_any_pieces(receiving, pieces):
    client, receiver, got = receiving
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    stream = b"".join(frame_octets(n, n) for n in range(30))
    for start in range(0, len(stream), pieces):
        client.sendall(stream[start : start + pieces])
        receiver.drain(7)
    drain_until(receiver, got, 30)
    assert got == [(frame_octets(n, n), 7) for n in range(30)]


def test_long_stream_goes_through_a_bounded_buffer(receiving):
    client, receiver, got = receiving
    client.setblocking(False)
    stream = b"".join(frame_octets(n % 250, 2047) for n in range(400))
    position = 0
    while len(got) < 400:
        with contextlib.suppress(BlockingIOError):
            position += client.send(stream[position:])
        receiver.drain(7)
    assert b"".join(data for data, _ in got) == stream


def test_drain_is_bounded_however_small_the_frames_are(receiving):
    client, receiver, got = receiving
    client.sendall(frame_octets(0, 0) * (FRAMES_PER_DRAIN + 100))
    drain_until(receiver, got, 1)
    assert len(got) <= FRAMES_PER_DRAIN
    drain_until(receiver, got, FRAMES_PER_DRAIN + 100)
    assert receiver.drain(7) == 0


def test_frame_of_another_type_closes_with_the_reason(receiving):
    client, receiver, got = receiving
    client.sendall(frame_octets(1) + b"\x06\x50" + bytes(6) + frame_octets(2))
    drain_until(receiver, got, 2)
    assert [data for data, _ in got] == [frame_octets(1)]
    assert receiver.closed == "frame of type 5, only type 4 may follow a type 4"
    assert receiver.drain(7) == 0
    assert receiver.fileno() == -1


def test_end_of_the_stream_is_a_reason_too(receiving):
    client, receiver, got = receiving
    client.sendall(frame_octets(1) + b"\x20")
    client.close()
    drain_until(receiver, got, 2)
    assert receiver.closed == "closed by the peer"
    assert len(got) == 1


def test_reset_is_a_reason_too(receiving):
    client, receiver, got = receiving
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    drain_until(receiver, got, 1)
    assert receiver.closed == "ECONNRESET"


def test_listener_in_use_names_the_holder(listener):
    with pytest.raises(EnvironmentalError, match=r"^TCP 127.0.3.21:34980 is in use by process \d+"):
        open_tcp_listener(THERE)


def test_listener_on_a_foreign_address_is_refused():
    with pytest.raises(EnvironmentalError, match="is not an address of this machine"):
        open_tcp_listener("203.0.113.9")


def test_tcp_answer_uses_connection_of_request(receiving):
    client, receiver, got = receiving
    client.sendall(frame_octets(1))
    drain_until(receiver, got, 1)
    assert receiver.sender_of(memoryview(b"")) == receiver.name
    assert receiver.name.startswith(CONNECTION)
    assert receiver.send(out_frame(2))
    assert read(client, 22) == frame_octets(2)


def test_tcp_slow_reader_loses_answers_without_effect_on_others(receiving):
    client, receiver, got = receiving
    client.sendall(frame_octets(1))
    drain_until(receiver, got, 1)
    results = [receiver.send(out_frame(number % 250, 2000)) for number in range(4000)]
    assert not all(results)
    assert not receiver.closed
    client.sendall(frame_octets(3))
    drain_until(receiver, got, 2)
    # Once it reads, what was begun is finished by the cycle's drain.
    expected = b"".join(frame_octets(n % 250, 2000) for n, sent in enumerate(results) if sent)
    client.settimeout(5)
    received = b""
    while len(received) < len(expected):
        receiver.drain(7)
        received += client.recv(65536)
    assert received == expected


def test_tcp_answer_to_closed_peer_ends_connection(receiving):
    client, receiver, _ = receiving
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    limit = time.monotonic() + 5
    while receiver.send(out_frame(1)):
        assert time.monotonic() < limit
    assert receiver.closed in {"ECONNRESET", "EPIPE"}
    assert not receiver.send(out_frame(1))
    assert receiver.drain(7) == 0


def test_tcp_sender_hands_answers_to_handlers(listener):
    got = []
    errors = {}

    def take(data, size, at_ns, origin):
        got.append((bytes(data[:size]), at_ns, origin.sender_of(data)))
        assert origin.source_of(data) == socket.inet_aton(
            DESTINATION.removeprefix("tcp://").split(":")[0]
        )

    sender = TcpSender(DESTINATION, HERE, errors, [take])
    try:
        sender.poll(0)
        with listener.accept()[0] as connection:
            until(sender, lambda: sender.connected)
            assert sender.send(out_frame(1), 0)
            assert read(connection, 22) == frame_octets(1)
            connection.sendall(frame_octets(8) + frame_octets(9))
            until(sender, lambda: len(got) == 2, now_ns=5)
        until(sender, lambda: errors)
    finally:
        sender.close()
    assert got == [(frame_octets(n), 5, DESTINATION) for n in (8, 9)]
    assert errors == {"ECONNRESET": 1}
    assert not sender.connected


pytestmark = pytest.mark.net

TCPWRITER_HERE = "127.0.3.26"


@pytest.fixture
def ends():
    """A writer and the plain socket at the other end, which has little room."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind((TCPWRITER_HERE, 0))
        server.listen(1)
        sock = stack.enter_context(socket.create_connection(server.getsockname()))
        peer = stack.enter_context(server.accept()[0])
        peer.setblocking(False)
        yield TcpWriter(sock), peer


def frame(number, size=2000):
    return OutFrame(bytearray(struct.pack("<H", 0x4000 | size) + bytes([number]) * size), 0, "")


def read_of_tcpwriter(peer):
    try:
        return peer.recv(65536)
    except BlockingIOError:
        return b""


def test_a_frame_leaves_at_once(ends):
    writer, peer = ends
    assert writer.flush()
    assert writer.send(frame(1, 20))
    assert writer.flush()
    peer.setblocking(True)
    assert peer.recv(100) == bytes(frame(1, 20).buffer)


def test_a_peer_that_does_not_read_costs_no_time_and_no_memory(ends):
    writer, peer = ends
    begin = time.monotonic()
    sent = [number for number in range(2000) if writer.send(frame(number % 250))]
    assert time.monotonic() - begin < 5
    assert len(sent) < 1000
    assert len(writer._rest) < 2002
    # What was begun is whole, and nothing of the others is in between.
    expected = b"".join(bytes(frame(number % 250).buffer) for number in sent)
    got = b""
    limit = time.monotonic() + 5
    while len(got) < len(expected) and time.monotonic() < limit:
        got += read_of_tcpwriter(peer)
        writer.flush()
    assert got == expected
    assert writer.send(frame(1))


def test_tcp_writer_unfinished_frame_keeps_its_content(ends):
    writer, peer = ends
    out = frame(7)
    count = 0
    while writer.send(out) and not writer._rest:
        count += 1
    out.view[2:] = bytes(2000)  # the next cycle patches it
    got = b""
    limit = time.monotonic() + 5
    while len(got) < 2002 * (count + bool(writer._rest)) and time.monotonic() < limit:
        writer.flush()
        got += read_of_tcpwriter(peer)
    assert set(got[2::2002]) == {7}
    assert got.count(0) == 0


def test_a_connection_that_is_lost_raises(ends):
    writer, peer = ends
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()
    with pytest.raises(OSError, match=r"reset|Broken"):
        any(not writer.send(frame(1)) for _ in range(10_000))
