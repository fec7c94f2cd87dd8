"""Cycles while nothing but process data is under way, in the compiled part (``eap/cyclic``).

A cycle is quiet if it is one frame, all slaves exchange data, and neither a datagram of a procedure
nor another frame waits or is under way.  The compiled part then patches and compares that frame,
and counts.  Link and Cycle are the reference, and end the quiet time when anything else happens: a
procedure, a time-out, a frame with another header or working counter, or a question for counters.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

from devicebus.master.cyclicframe import PreparedFrame
from eap.compiled import cyclic


class QuietWord(IntEnum):
    """Numbers that Python and the compiled part share, 64 bits each."""

    UNTIL_NS = 0
    """Time at which something else is to be done; 0 while a cycle is not quiet."""
    INDEX = 1
    """Index of the frame that is under way; -1 without one."""
    SENT_NS = 2
    NEXT_INDEX = 3
    INDEXES = 4
    TIMEOUT_NS = 5
    """This and the next ones as in RoundTrip."""
    SMOOTHED_NS = 6
    VARIATION_NS = 7
    FLOOR_NS = 8
    CEILING_NS = 9
    SENT = 10
    """Frames sent and received since the link has counted them."""
    BACK = 11
    CYCLES = 12
    """This and the next ones as in CycleStats."""
    GOOD = 13
    RECEIVED_WKC = 14
    TRIP_NS = 15
    MAX_TRIP_NS = 16
    IS_GOOD = 17
    """1 if the last cycle has come back with the expected working counters."""
    TIME_NS = 18
    """Time of the reference clock, if HAS_TIME is not 0."""
    HAS_TIME = 19
    FULL = 20
    """Mailboxes that hold a message, as a bit set."""


def make_words() -> array[int]:
    """Return the words of a cycle that is not quiet."""
    words = array("q", bytes(8 * len(QuietWord)))
    words[QuietWord.INDEX] = -1
    return words


class QuietPlan(NamedTuple):
    """Places in the frame of a quiet cycle."""

    writes: Sequence[tuple[int, int, int]]
    """Offset in the frame, offset in the outputs, size."""
    reads: Sequence[tuple[int, int, int]]
    """The same for the inputs."""
    counters: Sequence[tuple[int, int]]
    """Offset and value of each working counter."""
    looks: Sequence[int]
    """Offset of the status of each mailbox."""
    time_at: int
    """Offset of the time of the reference clock; -1 without one."""


def compile_frame(
    frame: PreparedFrame, plan: QuietPlan, words: array[int], outputs: bytearray, inputs: bytearray
) -> Any | None:
    """Return a frame that the compiled part sends and receives; None without that part."""
    if cyclic is None:
        return None
    return cyclic.CycleFrame(
        bytes(frame.octets),
        words,
        outputs,
        inputs,
        _pack(plan.writes),
        _pack(plan.reads),
        _pack(plan.counters),
        struct.pack(f"={len(plan.looks)}q", *plan.looks),
        plan.time_at,
    )


def _pack(rows: Sequence[tuple[int, ...]]) -> bytes:
    return b"".join(struct.pack(f"={len(row)}q", *row) for row in rows)
