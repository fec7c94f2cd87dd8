"""Frames that services does not take, by reason."""

from __future__ import annotations

import asyncio
import itertools
import select
import socket
import time
from time import monotonic_ns

import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.net.ipsocket import prepare_receiver
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.runtime.drop_counters import DropCounters, DropReason
from eap.services.transports.mailbox_frames import (
    MAX_BACKOFF,
    MAX_FRUITLESS,
    MAX_SPIN_FRAMES,
    QUICK_NS,
    SPIN_LIMIT_NS,
    BusyPoller,
    FrameIntake,
    watch_channel,
)
from tests.support.cyclic import From
from tests.support.eventually import eventually

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


class Line:
    """A channel whose frames arrive at given times; to look for them takes a microsecond."""

    def __init__(self, *arrivals_ns: int) -> None:
        self.arrivals_ns = list(arrivals_ns)
        self.now_ns = 0
        self.looks = 0

    def clock(self) -> int:
        return self.now_ns

    def drain(self, now_ns: int) -> int:
        self.looks += 1
        self.now_ns += 1000
        waiting = [at_ns for at_ns in self.arrivals_ns if at_ns <= self.now_ns]
        del self.arrivals_ns[: len(waiting)]
        return len(waiting)

    def fileno(self) -> int:
        return -1

    def wake(self, drain: BusyPoller, at_ns: int) -> int:
        """Let the channel be drained at a time; return how many looks that took."""
        before, self.now_ns = self.looks, at_ns
        drain.drain()
        return self.looks - before


def test_poller_drains_once_for_a_rare_frame():
    line = Line(0, 10 * QUICK_NS, 20 * QUICK_NS)
    drain = BusyPoller(line, line.clock)
    assert [line.wake(drain, at_ns) for at_ns in line.arrivals_ns[:]] == [1, 1, 1]


def test_poller_polls_after_quick_frames():
    line = Line(0, QUICK_NS // 2, QUICK_NS // 2 + SPIN_LIMIT_NS // 2)
    drain = BusyPoller(line, line.clock)
    assert line.wake(drain, 0) == 1
    assert line.wake(drain, QUICK_NS // 2) > 2
    assert not line.arrivals_ns
    late_ns = line.now_ns - SPIN_LIMIT_NS - (QUICK_NS // 2 + SPIN_LIMIT_NS // 2)
    assert 0 <= late_ns < 5000, "given up as long after the last frame as promised"


def test_poller_backs_off_after_fruitless_polls():
    line = Line()
    drain = BusyPoller(line, line.clock)
    line.wake(drain, 0)
    looks = [line.wake(drain, line.now_ns + QUICK_NS // 2) for _ in range(4 * MAX_BACKOFF)]
    vain = [number for number, count in enumerate(looks) if count > 2]
    rests = [after - before - 1 for before, after in itertools.pairwise(vain)]
    assert rests[:4] == [1, 2, 4, 8]
    assert max(rests) == MAX_BACKOFF


def test_poller_resets_its_backoff_after_a_frame():
    line = Line()
    drain = BusyPoller(line, line.clock)
    line.wake(drain, 0)
    while True:  # until it rests for long
        begin = line.looks
        for _ in range(100):
            line.wake(drain, line.now_ns + QUICK_NS // 2)
        if line.looks == begin + 100:
            break
    while line.wake(drain, line.now_ns + QUICK_NS // 2) == 1:
        line.arrivals_ns = [line.now_ns + QUICK_NS // 2 + SPIN_LIMIT_NS // 2]
    line.arrivals_ns = []
    # Behind the frame that came, it was watched in vain once already.
    *trusted, last = (line.wake(drain, line.now_ns + 2 * QUICK_NS) for _ in range(MAX_FRUITLESS))
    assert min(trusted) > 2, "who was quick is waited for although he was interrupted"
    assert last == 1, "but not for ever"


def test_poller_limits_the_frames_of_a_poll():
    line = Line(*range(0, 100_000_000, 2000))
    drain = BusyPoller(line, line.clock)
    line.wake(drain, 0)
    left = len(line.arrivals_ns)
    line.wake(drain, line.now_ns)
    assert left - len(line.arrivals_ns) <= MAX_SPIN_FRAMES


@pytest.mark.net
def test_a_socket_is_drained_at_once_and_on_arrival(counters):
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

        asyncio.run(serve())
    assert counters.stats()["a"] == {"stale": 1, "mailbox": 1}
