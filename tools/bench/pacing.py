"""Parts that all processes of a measurement share: answers, waits, and the window of the sender."""

from __future__ import annotations

import select
from collections.abc import Callable
from time import monotonic_ns
from typing import Any

import msgspec

WINDOW = 2048
"""Frames on their way; the receive buffers of all receivers hold more."""
BURST = 64
"""Frames between two looks at the window and the clock."""
_ARRIVED_WITHIN_NS = 500_000_000


def answer(message: dict[str, Any]) -> None:
    """Print one line for the process that started this one."""
    print(msgspec.json.encode(message).decode(), flush=True)


def wait(seconds: float) -> None:
    """Let others work."""
    select.select([], [], [], seconds)


def send_for(seconds: float, send_burst: Callable[[], None], arrived: Callable[[], int]) -> float:
    """Send bursts of BURST frames, at most WINDOW frames ahead of what *arrived* counts.

    Returns:
        Seconds from the first frame sent to the last one arrived.
    """
    start_ns = monotonic_ns()
    end_ns = start_ns + int(seconds * 1e9)
    sent = 0
    while monotonic_ns() < end_ns:
        if sent - arrived() < WINDOW:
            send_burst()
            sent += BURST
    while arrived() < sent and monotonic_ns() < end_ns + _ARRIVED_WITHIN_NS:
        pass
    return (monotonic_ns() - start_ns) / 1e9
