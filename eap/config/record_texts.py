"""Texts and rules of recordings, for ``eapctl record start`` and for the key ``record``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import NamedTuple

from eap.config.record_sections import RecordKind, RecordSection
from eap.patterns import compile_patterns
from eap.quantities import duration

DAY_NS = 86_400 * 10**9
LONGEST_NS = 3650 * DAY_NS
LONGEST_RING_NS = DAY_NS
BEFORE_NS, AFTER_NS = 20 * 10**9, 10 * 10**9
"""Default times around the moment in which a condition becomes true."""
SPLIT_NS, KEEP = 3600 * 10**9, 24
"""Defaults of the key ``record``: nobody ends such a recording before the disk is full."""
COUNTERS = ("lost", "late", "duplicated", "reordered", "timeouts", "dropped", "skipped", "overruns")
"""Names of counters that a condition may have, alone or as ``STATION/NAME``."""
STORE_SCHEMES = ("postgresql", "influx+http", "influx+https", "influx+udp")
_SECONDS = {"ms": 0.001, "s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400}
_BYTES = {"KB": 1000, "MB": 1000**2, "GB": 1000**3}
_AMOUNT = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)")
_MOST_CYCLES = 10**9


class RecordTimes(NamedTuple):
    """Times of a recording in nanoseconds, 0 for none."""

    ring_ns: int = 0
    before_ns: int = 0
    after_ns: int = 0


class Distance(NamedTuple):
    """Distance of recorded cycles; *every_ms* goes before *every_cycles*."""

    every_cycles: int = 1
    every_ms: int = 0


class FileSplit(NamedTuple):
    """Longest time or largest size of a file, 0 for no limit."""

    split_ns: int = 0
    split_bytes: int = 0


def parse_time(text: str | int) -> int:
    """Return the nanoseconds of a time such as ``20s``; raise ValueError if *text* is none."""
    return _parse_time(text, LONGEST_NS)


def parse_ring(text: str | int) -> int:
    """Return the nanoseconds of a time in memory; raise ValueError if *text* is none."""
    return _parse_time(text, LONGEST_RING_NS)


def _parse_time(text: str | int, longest_ns: int) -> int:
    match = _AMOUNT.fullmatch(str(text).strip())
    unit = _SECONDS.get(match[2].lower() or "s") if match else None
    ns = int(float(match[1]) * unit * 1e9) if match and unit else 0
    if not 0 < ns <= longest_ns:
        longest = duration(longest_ns // 1000)
        raise ValueError(
            f"{text!r} is not a time: expected for example 20s, 500ms, 10min or 1h, {longest} at"
            " most"
        )
    return ns


def parse_every(text: str | int) -> Distance:
    """Return the distance of recorded cycles; raise ValueError if *text* is none."""
    match = re.fullmatch(r"(\d+)(ms)?", str(text).strip(), re.IGNORECASE)
    number = int(match[1]) if match else 0
    if match is None or not 0 < number <= _MOST_CYCLES:
        raise ValueError(f"{text!r}: expected cycles, such as 10, or a time such as 100ms")
    return Distance(1, number) if match[2] else Distance(number)


def parse_split(text: str) -> FileSplit:
    """Return the limit of a file, a time or a size; raise ValueError if *text* is none."""
    match = _AMOUNT.fullmatch(text.strip())
    if match and (unit := _BYTES.get(match[2].upper())):
        size = int(float(match[1]) * unit)
        if size >= 1:
            return FileSplit(split_bytes=size)
    elif match and (seconds := _SECONDS.get(match[2].lower())):
        ns = int(float(match[1]) * seconds * 1e9)
        if 0 < ns <= LONGEST_NS:
            return FileSplit(ns)
    raise ValueError(f"{text!r}: expected a time such as 1h, or a size such as 1GB")


def find_contradiction(
    kind: str, every: Distance, times: RecordTimes, when: str, to: str, *, has_files: bool
) -> tuple[str, str] | None:
    """Return the option that does not go with the others, and the reason; None if all do.

    Args:
        kind: ``values`` or ``frames``.
        every: Distance of recorded cycles.
        times: As they were given.
        when: The condition.
        to: URL of a store.
        has_files: Whether an option for files was given.
    """
    if kind == RecordKind.FRAMES and every != Distance():
        return "every", "it is for values: frames are recorded as they come"
    if not when and (times.before_ns or times.after_ns):
        return "before" if times.before_ns else "after", "it needs a condition (when)"
    if times.ring_ns and times.before_ns > times.ring_ns:
        return "before", "it is longer than the ring"
    if to and (kind == RecordKind.FRAMES or times.ring_ns or when or has_files):
        return "to", "a store takes values as they come: without frames, a ring, or files"
    return None


def completed(times: RecordTimes, when: str) -> RecordTimes:
    """Return *times* with the defaults of a recording with the condition *when*."""
    if not when:
        return times
    before_ns = times.before_ns or times.ring_ns or BEFORE_NS
    return RecordTimes(max(times.ring_ns, before_ns), before_ns, times.after_ns or AFTER_NS)


def times_of(section: RecordSection) -> RecordTimes:
    """Return the times of a section that has no findings, with their defaults."""
    times = RecordTimes(
        parse_ring(section.ring) if section.ring else 0,
        parse_ring(section.before) if section.before else 0,
        parse_time(section.after) if section.after else 0,
    )
    return completed(times, section.when)


def split_of(section: RecordSection) -> FileSplit:
    """Return the file limits of a section that has no findings, with their default."""
    if section.split:
        return parse_split(section.split)
    needs_none = section.to or section.ring or section.when
    return FileSplit() if needs_none else FileSplit(SPLIT_NS)


def matcher(patterns: Iterable[str]) -> Callable[[str], bool]:
    """Return a function that says whether ``STATION/NAME`` is selected; all are without patterns.

    A pattern is ``STATION`` or ``STATION/NAME``; ``*`` stands for any text, ``?`` for a character.
    """
    texts = [each if "/" in each else f"{each}/*" for each in patterns]
    return compile_patterns(texts or ["*"])
