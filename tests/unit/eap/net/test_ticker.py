"""Waiting for a time, a descriptor or a signal."""

from __future__ import annotations

import os
import signal
import time
from contextlib import closing

import pytest

from eap.compiled import cyclic
from eap.net.ticker import Ticker

pytestmark = [pytest.mark.net, pytest.mark.quiet]

LATER_NS = 10_000_000_000


@pytest.fixture(params=[None, cyclic], ids=["python", "compiled"])
def path(request, monkeypatch):
    """Wait by Python, or by the compiled part."""
    if request.param is None:
        monkeypatch.setattr("eap.net.ticker.cyclic", None)
    elif cyclic is None:
        pytest.skip("without compiled part")


@pytest.fixture(params=[False, True], ids=["sleeps", "spins"])
def ticker(path, request):
    made = Ticker(spins=request.param)
    yield made
    made.close()


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def wait_us(ticker, after_us):
    """Return what the wait said and how late it was."""
    deadline_ns = time.monotonic_ns() + after_us * 1000
    return ticker.wait(deadline_ns), time.monotonic_ns() - deadline_ns


def test_deadline_is_never_early(ticker):
    for after_us in (1, 100, 2000):
        reached, late_ns = wait_us(ticker, after_us)
        assert reached
        assert late_ns >= 0


def test_deadline_is_kept_with_a_silent_descriptor(ticker, pipe):
    ticker.register(pipe[0])
    for after_us in (1, 100, 2000):
        reached, late_ns = wait_us(ticker, after_us)
        assert reached
        assert late_ns >= 0


def test_deadline_in_the_past_returns_at_once(ticker):
    assert ticker.wait(time.monotonic_ns() - LATER_NS)
    assert ticker.wait(0)


def test_readable_descriptor_ends_the_wait(ticker, pipe):
    ticker.register(pipe[0])
    os.write(pipe[1], b"x")
    assert not ticker.wait(time.monotonic_ns() + LATER_NS)
    os.read(pipe[0], 1)
    assert wait_us(ticker, 500)[0]


def test_ticker_ignores_unregistered_descriptor(ticker, pipe):
    ticker.register(pipe[0])
    os.write(pipe[1], b"x")
    ticker.unregister(pipe[0])
    ticker.unregister(pipe[0])
    assert wait_us(ticker, 500)[0]


@pytest.mark.parametrize("with_descriptor", [False, True])
def test_signal_ends_the_wait_and_its_handler_has_run(ticker, pipe, with_descriptor):
    if with_descriptor:
        ticker.register(pipe[0])
    seen = []
    before = signal.signal(signal.SIGALRM, lambda number, _frame: seen.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        assert not ticker.wait(time.monotonic_ns() + LATER_NS)
        assert seen == [signal.SIGALRM]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_spinning_ticker_takes_the_processor_and_another_one_does_not(path, pipe):
    shares = []
    for spins in (False, True):
        with closing(Ticker(spins=spins)) as ticker:
            ticker.register(pipe[0])
            before_ns, end_ns = time.thread_time_ns(), time.monotonic_ns() + 100_000_000
            while not ticker.wait(end_ns):
                pass
            shares.append(time.thread_time_ns() - before_ns)
    assert shares[1] > 5 * shares[0]


@pytest.mark.skipif(cyclic is None, reason="without compiled part")
def test_compiled_waiter_refuses_what_it_could_not_use():
    waiter = cyclic.Waiter
    with pytest.raises(ValueError, match="memory for an event"):
        waiter(0, 0, bytearray(4), 2, 1)
    with pytest.raises(ValueError, match="shorter than itself"):
        waiter(0, 0, bytearray(64), 1, 2)
    with pytest.raises(BufferError):
        waiter(0, 0, bytes(64), 2, 1)
    made = waiter(-1, -1, bytearray(64), 2, 1)  # of closed descriptors: a wait ends at once
    assert made.wait(time.monotonic_ns() + LATER_NS) == 0
    assert made.wait((1 << 63) - 1) == 0
    with pytest.raises(OverflowError):
        made.wait(1 << 63)


def test_closing_twice_is_harmless(pipe):
    ticker = Ticker()
    ticker.register(pipe[0])
    ticker.close()
    ticker.close()
    assert wait_us(ticker, 100)[0]


def test_those_that_are_readable_are_named(ticker, pipe):
    other, far = os.pipe()
    try:
        for fd in (pipe[0], other):
            ticker.register(fd)
        assert ticker.wait(time.monotonic_ns() + 1000)
        assert ticker.arrivals() == []
        os.write(pipe[1], b"x")
        assert not ticker.wait(time.monotonic_ns() + LATER_NS)
        assert ticker.arrivals() == [pipe[0]]
        os.write(far, b"x")
        assert not ticker.wait(time.monotonic_ns() + LATER_NS)
        assert set(ticker.arrivals()) == {pipe[0], other}
        assert ticker.wait(0)
        assert ticker.arrivals() == []
        ticker.unregister(other)
    finally:
        os.close(other)
        os.close(far)
