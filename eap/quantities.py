"""Quantities in words: durations, sizes, numbers of things and times, and the quality of a PD."""

from __future__ import annotations

QUALITY_MAX = 0xFFFF
"""Saturation value of a quality: 6.5535 s."""


def duration(us: int | None) -> str:
    """Return microseconds in the unit that keeps the number short; empty if they are unknown."""
    if us is None:
        return ""
    if us < 1000:
        return f"{us} µs" if us else "0"
    if us < 1_000_000:
        return f"{us / 1000:.1f} ms"
    seconds = us / 1_000_000
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def quality(units: int | None) -> str:
    """Return a quality (in units of 100 us) as a time; empty while nothing was received."""
    if units == QUALITY_MAX:
        return "> 6.5 s"
    return duration(None if units is None else units * 100)


def age(at_s: float, now_s: float) -> str:
    """Return the time from *at_s* to *now_s*, none if clocks differ, as a duration."""
    return duration(max(0, round((now_s - at_s) * 1e6)))


def size(number: int) -> str:
    """Return a number of bytes in the decimal unit that keeps it short."""
    for unit, bytes_of_unit in (("GB", 10**9), ("MB", 10**6), ("kB", 1000)):
        if number >= bytes_of_unit:
            return f"{number / bytes_of_unit:.1f} {unit}"
    return count(number, "byte")


def times(count: int) -> str:
    """Return a number of times as text."""
    return "once" if count == 1 else f"{count} times"


def count(number: int, thing: str) -> str:
    """Return *number* and *thing*, in singular or plural."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
