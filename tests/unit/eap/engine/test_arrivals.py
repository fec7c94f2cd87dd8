"""Descriptors between cycles: served at once, but never for most of the time."""

from __future__ import annotations

import os
import time

import pytest

from eap.engine import arrivals as module
from eap.engine.arrivals import Arrivals
from eap.net.ticker import Ticker

pytestmark = pytest.mark.net

MS = 1_000_000
LATER_NS = 10_000 * MS


@pytest.fixture
def ticker():
    made = Ticker()
    yield made
    made.close()


@pytest.fixture
def pipes():
    ends = [os.pipe() for _ in range(2)]
    yield ends
    for pair in ends:
        for end in pair:
            os.close(end)


def in_ms(milliseconds):
    return time.monotonic_ns() + milliseconds * MS


def test_only_who_has_something_is_served(ticker, pipes):
    served = []
    handlers = {
        read: lambda now_ns, read=read: served.append((os.read(read, 1), now_ns))
        for read, _ in pipes
    }
    arrivals = Arrivals(ticker, handlers)
    before_ns = time.monotonic_ns()
    os.write(pipes[1][1], b"x")
    assert not arrivals.wait(in_ms(10_000))
    ((octet, at_ns),) = served
    assert octet == b"x"
    assert before_ns < at_ns <= time.monotonic_ns()
    assert arrivals.wait(in_ms(1))
    assert len(served) == 1


def test_what_never_ends_gets_its_share_and_cycles_theirs(ticker, pipes, monkeypatch):
    monkeypatch.setattr(module, "WINDOW_NS", 50 * MS)
    monkeypatch.setattr(module, "SHARE_NS", 10 * MS)
    busy = 0

    def never_ready(now_ns):
        nonlocal busy
        end_ns = now_ns + MS
        while time.monotonic_ns() < end_ns:
            pass
        busy += 1

    os.write(pipes[0][1], b"x")  # and nobody reads it
    arrivals = Arrivals(ticker, {pipes[0][0]: never_ready})
    end_ns = in_ms(500)
    cycles = late = 0
    while time.monotonic_ns() < end_ns:
        due_ns = in_ms(5)
        while not arrivals.wait(due_ns):
            pass
        cycles += 1
        late += time.monotonic_ns() > due_ns + 20 * MS
    assert 20 <= busy <= 200
    assert cycles >= 50
    assert late <= cycles // 10


def test_a_wait_for_the_next_window_is_no_deadline(ticker, pipes, monkeypatch):
    monkeypatch.setattr(module, "SHARE_NS", 0)
    os.write(pipes[0][1], b"x")
    served = []
    arrivals = Arrivals(ticker, {pipes[0][0]: served.append})
    deadline_ns = time.monotonic_ns() + LATER_NS
    while len(served) < 3:
        assert not arrivals.wait(deadline_ns)
    assert served[2] - served[1] >= module.WINDOW_NS // 2
