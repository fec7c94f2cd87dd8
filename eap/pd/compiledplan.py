"""Plans of frames and handlers of ports for the compiled part, ``eap/cyclic``.

The compiled part takes a frame if its layout is known and usual, it comes from the same address as
the one before, and no sequence tracker has to enter a loss, a reordered frame or a wrapped counter.
It looks at all of that before it changes anything, and leaves every other frame to Python.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from eap.codec.pd import CYCLE_OFFSET, FIRST_PD
from eap.compiled import cyclic
from eap.pd.words import TRACKER_START, RxWord, StationWord

if TYPE_CHECKING:
    from eap.pd.address import NetIdLearner
    from eap.pd.link import FrameHandler
    from eap.pd.subscription import FramePlan

_OFFSETS = (
    StationWord.CYCLE,
    StationWord.ENGINE_SEQUENCE,
    *(
        word - TRACKER_START
        for word in (
            RxWord.RECEIVED,
            RxWord.DUPLICATED,
            RxWord.LATE,
            RxWord.STATE,
            RxWord.LAST_CYCLE,
            RxWord.ARRIVED_AT_NS,
            RxWord.ARRIVED_IN_CYCLE,
            RxWord.BEHIND,
            RxWord.JITTER_MAX_US,
            RxWord.JITTER,
            RxWord.SIZE,
        )
    ),
    CYCLE_OFFSET,
    FIRST_PD,
)
_part = struct.Struct("=8q").pack
_copy = struct.Struct("=3q").pack

# Built from a source with another layout of the image: then nothing of it is used.
_cyclic = cyclic if cyclic is not None and _OFFSETS == cyclic.OFFSETS else None


def compile_plan(plan: FramePlan) -> object:
    """Return what the compiled part carries out for *plan*; None if Python has to."""
    if _cyclic is None or not plan.is_usual:
        return None
    counters = [counter for pd in plan.refused for counter in pd.counters]
    parts = bytearray()
    try:
        for tracker, copies in plan.parts:
            parts += _part(*tracker.timing_numbers, len(copies))
            for source, target in copies:
                parts += _copy(source.start, target.start, source.stop - source.start)
        return _cyclic.Plan(
            plan.end,
            b"".join(plan.expected),
            bytes(parts),
            struct.pack(f"={len(counters)}q", *counters),
            plan.watch,
        )
    except (ValueError, OverflowError, struct.error):  # times that no counter of 64 bits holds
        return None


def compile_handler(handle: FrameHandler, learner: NetIdLearner | None) -> Any:
    """Return a handler that leaves to *handle* what is not usual; None without compiled part.

    As long as *learner*, which is behind *handle*, wants to see frames, none is usual.
    """
    return None if _cyclic is None else _cyclic.PortHandler(handle, learner)
