"""Parts that all processes of a measurement share: answers, waits, and the window of the sender."""

from __future__ import annotations

import select
from collections.abc import Callable
from time import monotonic_ns
from typing import Any

import msgspec

from eap.net.ticker import Ticker
from tools.bench.network import Page

CYCLE_NS = 1_000_000
"""Time between two paced frames."""
WINDOW = 2048
"""Frames on their way; the receive buffers of all receivers hold more."""
BURST = 64
"""Frames between two looks at the window and the clock."""
_EXCHANGES = 16
"""Between two looks at the clock."""
ARRIVED_WITHIN_NS = 500_000_000
"""A sender waits so long for its last frames."""


def answer(message: dict[str, Any]) -> None:
    """Print one line for the process that started this one."""
    print(msgspec.json.encode(message).decode(), flush=True)


def wait(seconds: float) -> None:
    """Let others work."""
    select.select([], [], [], seconds)


def send_for(
    seconds: float,
    send_burst: Callable[[], None],
    arrived: Callable[[], int],
    window: int = WINDOW,
) -> float:
    """Send bursts of BURST frames, at most *window* frames ahead of what *arrived* counts.

    Returns:
        Seconds from the first frame sent to the last one arrived.
    """
    start_ns = monotonic_ns()
    end_ns = start_ns + int(seconds * 1e9)
    sent = 0
    while monotonic_ns() < end_ns:
        if sent - arrived() < window:
            send_burst()
            sent += BURST
    while arrived() < sent and monotonic_ns() < end_ns + ARRIVED_WITHIN_NS:
        pass
    return (monotonic_ns() - start_ns) / 1e9


def send_stamps(seconds: float, send: Callable[[int], object]) -> None:
    """Call *send* with the time just before it, once each millisecond; answer with the number."""
    ticker, due_ns, count = Ticker(), monotonic_ns(), int(seconds * 1e9 / CYCLE_NS)
    for _ in range(count):
        due_ns += CYCLE_NS
        while not ticker.wait(due_ns):
            pass
        send(monotonic_ns())
    answer({"sent": count})


def run_phases(
    words: memoryview,
    job: dict[str, Any],
    exchange: Callable[[], object],
    good: Callable[[], int],
) -> list[float]:
    """Run *exchange* again and again in each phase that begins; return good ones a second.

    A phase begins when its number is set in *words*.  Before the first one exchanges go on, for the
    watchdogs of slaves; before the others there are none, for something takes the place of slaves.

    Raises:
        RuntimeError: no exchange of a phase was good.
    """
    rates = []
    for phase in range(1, job["phases"] + 1):
        answer({"ready": True})
        while words[Page.PHASE] < phase:
            if phase == 1:
                exchange()
            else:
                wait(0.001)
        begin_ns, before = monotonic_ns(), good()
        end_ns = begin_ns + int(job["seconds"] * 1e9)
        while (now_ns := monotonic_ns()) < end_ns:
            for _ in range(_EXCHANGES):
                exchange()
        if good() == before:
            raise RuntimeError("no cycle had the right working counter")
        rates.append((good() - before) / (now_ns - begin_ns) * 1e9)
    return rates
