"""Batches of messages: sizes, times, partial sends, refusals."""

from __future__ import annotations

import contextlib
import errno
import socket
import time

import pytest

from eap.compiled import cyclic
from eap.net import mmsg
from eap.net.mmsg import (
    BATCH,
    SO_TIMESTAMPNS,
    ReceiveBatch,
    SendBatch,
    count_error,
    note_receive_error,
)
from eap.net.udp import _socket_address, enable_errors, read_errors
from eap.pd.link import OutFrame

pytestmark = pytest.mark.net


@pytest.fixture
def pair():
    """Two bound sockets; the second is the receiver."""
    with contextlib.ExitStack() as stack:
        sockets = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        ]
        for sock in sockets:
            sock.bind(("127.0.3.10", 0))
            sock.setblocking(False)
        sockets[1].setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        yield sockets


def frames_to(sock, count, size=20):
    host, port = sock.getsockname()
    return [OutFrame(bytearray([n]) * (size + n), 0, f"{host}:{port}") for n in range(count)]


def receive(batch, sock):
    count = batch.reader(sock.fileno())()
    if count == 1:
        view, size, at_ns = batch.arrival()
        return [(bytes(view[:size]), at_ns)]
    sizes, times = batch.arrivals(count)
    return [
        (bytes(view[:size]), at_ns)
        for view, size, at_ns in zip(batch.views, sizes, times, strict=False)
    ]


@pytest.mark.parametrize("count", [1, 2, BATCH])
def test_batch_arrives_whole_in_order_and_stamped(pair, count):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, count)
    for _ in range(2):  # the second round uses what the first prepared
        before = time.monotonic_ns()
        assert out.send(frames) == ()
        after = time.monotonic_ns()
        got = receive(batch, receiver)
        assert [data for data, _ in got] == [bytes(frame.buffer) for frame in frames]
        times = [at_ns for _, at_ns in got]
        # Two clocks are read one after the other: allow for a stall between the readings.
        assert before - 5_000_000 < times[0] <= times[-1] < after + 5_000_000
        assert times == sorted(times)
    assert out.errors == {}


def test_patched_octets_are_sent_by_a_prepared_batch(pair):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = tuple(frames_to(receiver, 2))
    out.send(frames)
    receive(batch, receiver)
    frames[1].view[3] = 0xEE
    out.send(frames)
    assert receive(batch, receiver)[1][0][3] == 0xEE


def test_nothing_waiting_is_no_error(pair):
    errors: dict[str, int] = {}
    assert ReceiveBatch().reader(pair[1].fileno())() == -1
    note_receive_error(errors)
    assert errors == {}


def test_broken_descriptor_is_counted_by_name():
    errors: dict[str, int] = {}
    assert ReceiveBatch().reader(-1)() == -1
    note_receive_error(errors)
    assert errors == {"EBADF": 1}


def test_missing_stamp_falls_back_to_now_and_the_batch_recovers(pair):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, 3)
    receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)
    for count in (1, 3):
        out.send(frames[:count])
        before = time.monotonic_ns()
        times = [at_ns for _, at_ns in receive(batch, receiver)]
        assert len(times) == count
        assert all(before <= at_ns <= time.monotonic_ns() for at_ns in times)
    receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    out.send(frames)
    times = [at_ns for _, at_ns in receive(batch, receiver)]
    assert len(times) == 3
    assert times[0] < times[2]


def test_wall_clock_set_back_gives_no_time_in_the_future(pair, monkeypatch):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    monkeypatch.setattr("eap.net.mmsg.time_ns", lambda: time.time_ns() - 3600 * 10**9)
    for count in (1, 2):
        out.send(frames_to(receiver, count))
        assert all(at_ns <= time.monotonic_ns() for _, at_ns in receive(batch, receiver))


def test_interruption_between_the_clocks_moves_no_arrival(pair, monkeypatch):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    stalls = iter([250_000])
    monkeypatch.setattr("eap.net.mmsg.time_ns", lambda: time.time_ns() + next(stalls, 0))
    before = time.monotonic_ns()
    out.send(frames_to(receiver, 2))
    assert receive(batch, receiver)[0][1] > before - 100_000


def test_wall_clock_set_ahead_is_followed(pair, monkeypatch):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    monkeypatch.setattr("eap.net.mmsg.time_ns", lambda: time.time_ns() + 3600 * 10**9)
    out.send(frames_to(receiver, 1))
    assert receive(batch, receiver)[0][1] < time.monotonic_ns() - 3599 * 10**9


def test_batch_across_a_second_keeps_every_time():
    batch = ReceiveBatch()
    for n, second in enumerate((7, 7, 8)):
        batch._stamps[n * 4 + 2], batch._stamps[n * 4 + 3] = second, 999 - n
    assert batch._times(3, 1000) == [7_000_001_999, 7_000_001_998, 8_000_001_997]


@pytest.mark.parametrize("bad", [0, 1, 2])
def test_partial_send_goes_on_behind_the_refused_frame(pair, bad):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, 3)
    huge = OutFrame(bytearray(70_000), 0, frames[0].destination)
    frames[bad] = huge
    assert out.send(frames) == [huge]
    assert out.errors == {"EMSGSIZE": 1}
    good = [bytes(frame.buffer) for frame in frames if frame is not huge]
    assert [data for data, _ in receive(batch, receiver)] == good


def test_refused_single_frame_is_returned(pair):
    out = SendBatch(pair[0], _socket_address)
    frames = [OutFrame(bytearray(70_000), 0, "127.0.3.10:9")]
    assert out.send(frames) == frames
    assert out.send(()) == ()
    assert out.errors == {"EMSGSIZE": 1}


def test_connected_socket_needs_no_address(pair):
    sender, receiver = pair
    sender.connect(receiver.getsockname())
    out, batch = SendBatch(sender), ReceiveBatch()
    frames = frames_to(receiver, 2)
    assert out.send(frames) == out.send(frames[:1]) == ()
    assert len(receive(batch, receiver)) == 3


def test_refusal_of_a_frame_is_not_held_against_the_next_one(pair):
    sender, receiver = pair
    enable_errors(sender)
    closed = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    closed.bind(("127.0.0.1", 0))
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    lost, taken = frames_to(closed, 1)[0], frames_to(receiver, 3)
    closed.close()
    for frames in ((lost, *taken), [lost], [taken[0]], (lost, lost, taken[1])):
        assert not out.send(frames)
    assert out.errors == {}
    assert batch.reader(receiver.fileno())() == 5
    assert len(read_errors(sender)) == 4


def test_send_batch_counts_own_error_after_second_try(pair):
    sender, receiver = pair
    out = SendBatch(sender, _socket_address)
    small, other, large = frames_to(receiver, 3)
    large = OutFrame(bytearray(70_000), 0, large.destination)
    assert out.send((small, large, other)) == [large]
    assert out.send([large]) == [large]
    assert out.errors == {"EMSGSIZE": 2}


def test_cache_of_batches_is_bounded(pair):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, 20)
    for first in frames:
        for second in frames:
            out.send((first, second))
        while batch.reader(receiver.fileno())() > 0:
            pass
    assert len(out._batches) <= 256
    assert out.errors == {}


def test_unknown_errno_is_counted_by_number():
    errors: dict[str, int] = {}
    count_error(errors, 99999)
    count_error(errors, errno.ENOBUFS)
    count_error(errors, errno.ENOBUFS)
    assert errors == {"99999": 1, "ENOBUFS": 2}


def test_send_batch_caches_are_bounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mmsg, "_CACHED_FRAMES", 8)
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with left, right:
        batch = SendBatch(left)
        for number in range(20):
            pair = [OutFrame(bytearray((number, n)), 0, "") for n in (1, 2)]
            assert batch.send(pair) == ()
            assert [right.recv(9) for _ in pair] == [bytes((number, 1)), bytes((number, 2))]
            assert len(batch._headers) <= 10


@pytest.mark.parametrize("count", [1, 3])
def test_receive_batch_gives_sender_of_held_message(pair, count):
    sender, receiver = pair
    SendBatch(sender, _socket_address).send(frames_to(receiver, count))
    batch = ReceiveBatch()
    assert batch.reader(receiver.fileno())() == count
    for position, view in enumerate(batch.views[:count]):
        assert batch.position(view) == position
        host, port = sender.getsockname()
        assert batch.sender(view) == (port, socket.inet_aton(host))
    assert batch.position(memoryview(b"other")) is None


@pytest.mark.parametrize("count", [1, 2])
def test_a_frame_that_is_too_large_for_the_network_says_so(pair, count):
    sender, receiver = pair
    batch = SendBatch(sender, _socket_address)
    frames = frames_to(receiver, count, size=65_508)
    assert list(batch.send(frames)) == frames
    assert all(frame.oversized for frame in frames)
    assert batch.errors == {"EMSGSIZE": count}
    refused = OutFrame(bytearray(3), 0, "0.0.0.1")
    assert list(batch.send([refused])) == [refused]
    assert not refused.oversized


def test_addresses_are_not_remembered_without_end(pair):
    sender, receiver = pair
    batch = SendBatch(sender, _socket_address)
    usual = frames_to(receiver, 2)
    batch.send(usual)
    for number in range(2 * mmsg._CACHED_ADDRESSES):
        batch.send([OutFrame(bytearray(3), 0, f"127.0.3.{number % 200 + 30}:{number + 1000}")])
    assert len(batch._addresses) <= mmsg._CACHED_ADDRESSES
    while receiver.recv(100) and not _is_empty(receiver):
        pass
    # What was prepared before still goes where it should.
    assert batch.send(usual) == ()
    assert {receiver.recv(100) for _ in usual} == {bytes(frame.buffer) for frame in usual}


def _is_empty(sock):
    try:
        sock.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return True
    return False


needs_compiled = pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")


class Origin:
    errors = 0

    def note_error(self, number):
        self.errors += 1
        return False

    def drain(self):
        return 7


ORIGIN = Origin()


def drain(batch, sock, handler):
    return batch.compiled_socket(sock.fileno(), [handler], ORIGIN, None)(0)


@needs_compiled
def test_compiled_receiver_hands_over_what_the_python_code_does(pair):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, 3)
    got = []

    def handle(view, size, at_ns, origin):
        got.append((bytes(view[:size]), at_ns, batch.sender(view), origin))

    for stamped in (1, 0, 1, 1):
        receiver.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamped)
        for count in (1, 3):
            before = time.monotonic_ns()
            out.send(frames[:count])
            assert drain(batch, receiver, handle) == count
            after = time.monotonic_ns()
            assert [each[0] for each in got] == [bytes(frame.buffer) for frame in frames[:count]]
            # Two clocks are read one after the other: allow for a stall between the readings.
            assert all(before - 5_000_000 < each[1] <= after for each in got)
            host, port = sender.getsockname()
            assert {each[2:] for each in got} == {((port, socket.inet_aton(host)), ORIGIN)}
            got.clear()
    assert drain(batch, receiver, handle) == 0


@needs_compiled
def test_compiled_receiver_raises_what_a_handler_raises_and_goes_on(pair):
    sender, receiver = pair
    out, batch = SendBatch(sender, _socket_address), ReceiveBatch()
    frames = frames_to(receiver, 2)

    def fail(*_):
        raise KeyError("handler")

    def again(*_):
        drain(batch, receiver, fail)

    for wrong, error in ((fail, KeyError), (again, RuntimeError)):
        out.send(frames)
        with pytest.raises(error):
            drain(batch, receiver, wrong)
    out.send(frames)
    assert drain(batch, receiver, lambda *_: None) == 2


@needs_compiled
def test_compiled_receiver_refuses_memory_that_does_not_fit():
    batch = ReceiveBatch()
    parts = [batch.octets, batch._control, batch._senders, 32, 0, batch.views]
    cyclic.Receiver(*parts)
    for index, wrong in (
        (0, batch.octets[7:]),
        (0, batch.octets[:BATCH]),
        (1, bytearray(7)),
        (2, bytearray(7)),
        (2, None),
        (3, 24),
        (4, -1),
        (4, 1 << 20),
        (5, batch.views[1:]),
        (5, []),
    ):
        with pytest.raises(ValueError, match="batch"):
            cyclic.Receiver(*parts[:index], wrong, *parts[index + 1 :])
    for handlers in ({}, ()):
        with pytest.raises(TypeError):
            batch.compiled_socket(0, handlers, ORIGIN, None)


@needs_compiled
def test_compiled_socket_leaves_draining_to_its_origin_when_it_may_not(pair):
    drain = ReceiveBatch().compiled_socket(pair[1].fileno(), [], ORIGIN, None)
    drain.may_drain = False
    assert drain(0) == 7
    drain.may_drain = True
    assert drain(0) == 0


@needs_compiled
def test_compiled_socket_tells_its_origin_of_errors_and_ends_with_it():
    origin = Origin()
    drain = ReceiveBatch().compiled_socket(-1, [], origin, None)
    assert (drain(0), origin.errors) == (0, 1)
    del origin
    assert drain(0) == 0
