"""Arrival statistics of one observed PD: rate, jitter, step of the sender, guess of the trigger.

Nothing is configured here: all is found from arrival times, cycle counters and data.  The cycle
counter tells best whether a sender is cyclic, as it counts the sender's own cycles (ETG.1005): with
the same step between all PDs the sender keeps a rhythm, however late the network delivers them.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum, auto
from itertools import pairwise

from eap.pd.words import Reason

_KEPT = 256
"""Latest arrivals that the statistics are made of."""
_LEAST = 5
"""Arrivals below which no trigger is guessed."""
_REGULAR = 0.7
"""Share of arrivals that have to keep a rhythm; the others may have been lost."""
_NEAR = 0.25
"""Deviation from the rhythm, in parts of the period, that counts as keeping it."""
_ALMOST_ALL = 0.9
_MOST_STEPS = 0x4000
"""A step beyond it is a counter that restarted, or bytes that do not count."""
_SWAPPED_STEPS = 64
"""Steps of a swapped counter that tell it from a counter in the usual order."""
_ORDER_AFTER = 4
"""Steps that have to agree before the order of the bytes counts as known."""


class CycleOrder(StrEnum):
    """Order of the bytes of a sender's cycle counter."""

    UNKNOWN = auto()
    LITTLE = auto()
    """As ETG.1005 has it."""
    SWAPPED = auto()
    CONSTANT = auto()
    """It never counts: terminals whose counter a user program has to increment."""


class CycleWatch:
    """The cycle counter of one sender, and the order of its bytes."""

    __slots__ = ("_changes", "_last", "_little", "_swapped", "_total")

    def __init__(self) -> None:
        self._last = -1
        self._total = self._changes = self._little = self._swapped = 0

    def enter(self, cycle: int) -> None:
        """Note the counter of another frame, read as little-endian."""
        last, self._last = self._last, cycle
        if last < 0:
            return
        self._total += 1
        if cycle == last:
            return
        self._changes += 1
        usual = cycle - last & 0xFFFF
        swapped = swap(cycle) - swap(last) & 0xFFFF
        # A counter of steps below 64 has large steps when its bytes are swapped, and vice versa.
        if usual <= _SWAPPED_STEPS:
            self._little += 1
        elif swapped <= _SWAPPED_STEPS:
            self._swapped += 1

    @property
    def order(self) -> CycleOrder:
        """Order of the bytes, as far as it is known."""
        if not self._changes:
            return CycleOrder.CONSTANT if self._total >= _ORDER_AFTER else CycleOrder.UNKNOWN
        if self._swapped >= _ORDER_AFTER and self._swapped > 8 * self._little:
            return CycleOrder.SWAPPED
        if self._changes < _ORDER_AFTER:
            return CycleOrder.UNKNOWN
        return CycleOrder.LITTLE


def swap(cycle: int) -> int:
    """Return a cycle counter with its two bytes exchanged."""
    return (cycle & 0xFF) << 8 | cycle >> 8


class Rhythm:
    """The latest arrivals of one PD.

    Attributes:
        received: All arrivals.
        first_ns: Time of the first one.
        last_ns: Time of the last one.
    """

    __slots__ = ("_changes", "_cycles", "_times", "first_ns", "last_ns", "received")

    def __init__(self) -> None:
        self.received = 0
        self.first_ns = self.last_ns = 0
        self._times = array("q")
        self._cycles = array("H")
        self._changes = bytearray()

    def enter(self, at_ns: int, cycle: int, *, is_changed: bool) -> None:
        """Note an arrival; the first one counts as changed."""
        if not self.received:
            self.first_ns = at_ns
        self.received += 1
        self.last_ns = at_ns
        # Cut now and then and not each time: that would move all of it for each arrival.
        if len(self._times) >= 2 * _KEPT:
            del self._times[:_KEPT], self._cycles[:_KEPT], self._changes[:_KEPT]
        self._times.append(at_ns)
        self._cycles.append(cycle)
        self._changes.append(is_changed)

    def measure(self, order: CycleOrder) -> Measured:
        """Return the statistics; *order* is that of the sender's cycle counter."""
        times = self._times[-_KEPT:]
        cycles = list(self._cycles[-_KEPT:])
        if order is CycleOrder.SWAPPED:
            cycles = [swap(each) for each in cycles]
        intervals = [max(after - before, 0) for before, after in pairwise(times)]
        steps = [after - before & 0xFFFF for before, after in pairwise(cycles)]
        changes = [bool(each) for each in self._changes[-_KEPT:]][1:]
        return Measured(self, intervals, steps, changes)


class Measured:
    """Statistics of the latest arrivals of a PD.

    Attributes:
        rate_hz: Arrivals a second between the first and the last one, None for a single one.
        step: Sender cycles between two of them, 0 if there is no fixed number.
        sender_cycle_us: Device cycle of the sender, 0 if unknown.
        period_us: Time between two arrivals if they keep a rhythm, else 0.
        jitter_us: 99th percentile of the deviation from the rhythm, None without one.
        jitter_max_us: Largest deviation, likewise.
        missed: Arrivals that the counter shows to be missing among the latest ones.
        trigger: Guess, None while too few arrived.
        timeout_ms: With CHANGE_TIMEOUT: time after which unchanged data comes again.
    """

    def __init__(
        self,
        rhythm: Rhythm,
        intervals: Sequence[int],
        steps: Sequence[int],
        changes: Sequence[bool],
    ) -> None:
        span_ns = rhythm.last_ns - rhythm.first_ns
        self.rate_hz = (rhythm.received - 1) * 1e9 / span_ns if span_ns > 0 else None
        self.step = _usual_step(steps)
        self.sender_cycle_us = self.period_us = self.missed = self.timeout_ms = 0
        self.jitter_us: int | None = None
        self.jitter_max_us: int | None = None
        self.trigger: Reason | None = None
        if len(intervals) + 1 < _LEAST:
            return
        counted = [(ns, step) for ns, step in zip(intervals, steps, strict=True) if step]
        if counted:
            self.sender_cycle_us = _round_us(_median([ns // step for ns, step in counted]))
        if self.step:
            self._follow_counter(intervals, steps)
        else:
            self._follow_clock(intervals)
        if self.period_us:
            self.trigger = Reason.CYCLE
            return
        self._guess_irregular(intervals, changes)

    def _follow_counter(self, intervals: Sequence[int], steps: Sequence[int]) -> None:
        """Measure against the sender's own cycles: what is lost is not jitter."""
        whole = [
            (ns, step // self.step)
            for ns, step in zip(intervals, steps, strict=True)
            if 0 < step < _MOST_STEPS
        ]
        period_ns = _median([ns // count for ns, count in whole if count])
        self.missed = sum(count - 1 for _, count in whole if count > 1)
        self._enter_rhythm(period_ns, [abs(ns - count * period_ns) for ns, count in whole if count])

    def _follow_clock(self, intervals: Sequence[int]) -> None:
        period_ns = _median(intervals)
        deviations = [abs(ns - period_ns) for ns in intervals]
        near = sum(each <= _NEAR * period_ns for each in deviations)
        if period_ns and near >= _REGULAR * len(deviations):
            self._enter_rhythm(period_ns, deviations)

    def _enter_rhythm(self, period_ns: int, deviations: Sequence[int]) -> None:
        if not period_ns or not deviations:
            return
        self.period_us = _round_us(period_ns)
        ranked = sorted(deviations)
        self.jitter_us = ranked[(len(ranked) - 1) * 99 // 100] // 1000
        self.jitter_max_us = ranked[-1] // 1000

    def _guess_irregular(self, intervals: Sequence[int], changes: Sequence[bool]) -> None:
        """Guess the trigger of a PD without a rhythm: an event also brings what did not change."""
        if sum(changes) >= _ALMOST_ALL * len(changes):
            self.trigger = Reason.CHANGE
            return
        repeats = [ns for ns, changed in zip(intervals, changes, strict=True) if not changed]
        usual = _median(repeats)
        # Sent again after a time-out: unchanged data comes after that time, and no gap is longer.
        same = min(repeats) >= usual * (1 - _NEAR) and max(intervals) <= usual * (1 + _NEAR)
        self.trigger = Reason.EVENT
        if usual and same and any(changes):
            self.trigger = Reason.CHANGE_TIMEOUT
            self.timeout_ms = max(1, round(usual / 1e6))


def _usual_step(steps: Sequence[int]) -> int:
    """Return the step that most arrivals have, 0 if none is usual."""
    if len(steps) + 1 < _LEAST:
        return 0
    step, seen = Counter(steps).most_common(1)[0]
    return step if 0 < step < _MOST_STEPS and seen >= _REGULAR * len(steps) else 0


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2] if values else 0


def _round_us(ns: int) -> int:
    """Return a cycle as a person would have configured it: 10000, not 9998."""
    us = ns / 1000
    for unit in (10_000, 1000, 500, 100, 50, 10):
        rounded = round(us / unit) * unit
        if rounded and abs(us - rounded) <= 0.01 * us:
            return rounded
    return max(1, round(us))
