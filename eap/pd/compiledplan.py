"""Plans of frames, handlers of ports and cycles of stations for the compiled part, ``eap/cyclic``.

The compiled part takes a frame if its layout is known and usual, it comes from the same address as
the one before, and no sequence tracker has to enter a loss, a reordered frame or a wrapped counter.
It looks at all of that before it changes anything, and leaves every other frame to Python.

It sends the frames of a port if all go by their schedule alone.  Otherwise Python selects them, and
it goes on where the kernel did not take some.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from eap.codec.pd import CYCLE_OFFSET, FIRST_PD
from eap.compiled import cyclic
from eap.pd.layout import RxSlot
from eap.pd.quality import QUALITY_MAX, QUALITY_NS, QUALITY_SIZE
from eap.pd.words import TRACKER_START, WAKE_FOR_CYCLES, RxWord, StationWord

if TYPE_CHECKING:
    from eap.pd.address import NetIdLearner
    from eap.pd.link import FrameHandler, OutFrame
    from eap.pd.publisher import FrameGroup
    from eap.pd.subscription import FramePlan
    from eap.pd.txframe import TxPd

_STATION_WORDS = (
    StationWord.CYCLE,
    StationWord.CYCLE_AT_NS,
    StationWord.FUTEX,
    StationWord.WAITERS,
    StationWord.ENGINE_SEQUENCE,
    StationWord.SERVICES_SEQUENCE,
    StationWord.APPLICATION_SEQUENCE,
    StationWord.OVERRUNS,
    StationWord.LATENESS_MAX_NS,
    StationWord.LATENESS,
    StationWord.SAMPLED_UNTIL,
)
_RX_WORDS = (RxWord.TRACKER, RxWord.RESPONSE_NS, RxWord.RECEIVED, RxWord.SIZE)
_TRACKER_WORDS = (
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
_NUMBERS = (CYCLE_OFFSET, FIRST_PD, QUALITY_MAX, QUALITY_NS, WAKE_FOR_CYCLES)
_OFFSETS = (
    *_STATION_WORDS,
    *_RX_WORDS,
    *(word - TRACKER_START for word in _TRACKER_WORDS),
    *_NUMBERS,
)
_part = struct.Struct("=8q").pack
_copy = struct.Struct("=3q").pack
_move = struct.Struct("=4q").pack
_origin = struct.Struct("=3q").pack
_row = struct.Struct("=4q").pack
_FIELD = -1
"""In place of the header of a subscription: the value comes from a controller."""

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


def compile_patch(
    out: OutFrame, placed: Iterable[tuple[TxPd, int]]
) -> Callable[[int], None] | None:
    """Return what writes counter, data and qualities into *out*; None without compiled part.

    Args:
        out: The frame.
        placed: Its PDs with the offsets of their data in its buffer.
    """
    if _cyclic is None:
        return None
    moves, origins = bytearray(), bytearray()
    for pd, offset in placed:
        gather = pd.gather
        image, inputs = gather.image, gather.inputs
        for memory, source, target, size in gather.runs:
            moves += _move(memory is inputs.memory, 8 * source, 8 * (offset + target), 8 * size)
        for memory, source, target, size in gather.bits:
            moves += _move(memory is inputs.memory, source, 8 * offset + target, size)
        for slot in () if pd.quality is None else pd.quality.slots:
            header = slot.offset if isinstance(slot, RxSlot) else _FIELD
            origins += _origin(offset - QUALITY_SIZE, slot.words, header)
    patch: Callable[[int], None] = _cyclic.Patch(
        out.buffer,
        out.headroom + CYCLE_OFFSET,
        (image.memory, inputs.memory),
        image.words,
        image.layout.cycle_us * 1000,
        bytes(moves),
        bytes(origins),
    )
    return patch


def make_send_plan(words: memoryview) -> Any:
    """Return a plan of the frames of one port that the compiled part sends; None without it."""
    return None if _cyclic is None else _cyclic.SendPlan(words)


def fill_send_plan(plan: Any, groups: Sequence[FrameGroup]) -> None:
    """Have *plan* send the frames of *groups*, which are all of the port."""
    frames = [frame for group in groups for frame in group.frames]
    rows = bytearray()
    for group in groups:
        for counters in group.counters:
            rows += _row(group.step, group.phase, *counters)
    plan.fill(
        [frame.whole.out for frame in frames], [frame.whole.patch for frame in frames], bytes(rows)
    )


def compile_cycle(words: memoryview, rarely_every: int, *parts: object) -> Any:
    """Return the compiled cycle of a station of these parts; None without compiled part.

    All other steps are lists, which its ``attach`` takes.

    Args:
        words: Of its image.
        rarely_every: Cycles between two drains of the ports that are drained rarely.
        parts: The steps that compute variables, run links, copy inputs, read controls, take a
            sample and wake waiting programs; the first two may be None.
    """
    return None if _cyclic is None else _cyclic.Cycle(words, rarely_every, parts)
