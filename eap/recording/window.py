"""Times of day, ISO 8601 and offsets that users give for a part of a recording."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from eap.errors import ConfigError
from eap.recording.rows import ALL, TimeWindow

_NS = 1_000_000_000
_OFFSET = re.compile(r"([+-])(\d+(?:\.\d+)?)\s*(ms|s|min|m|h)?")
_UNITS = {"ms": 0.001, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, None: 1.0}
_CLOCK = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d)(?:\.(\d{1,9}))?)?")
_ISO = re.compile(
    r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d):(\d\d)(?::(\d\d)(?:\.(\d{1,9}))?)?)?(Z|[+-]\d\d:?\d\d)?"
)
_EXPECTED = "expected 12:00, 12:00:05.5, +30s, -10s or 2026-11-23T12:00:00Z"


def parse_time(text: str, base_ns: int, end_ns: int) -> int:
    """Return Unix time in nanoseconds.

    ``+30s`` counts from *base_ns*, ``-10s`` from *end_ns*, the end of the recording.  A time of day
    is the first one not before the minute of *base_ns*, in local time; ISO 8601 without a zone is
    local time too.

    Raises:
        ConfigError: *text* is no time.
    """
    text = text.strip()
    if match := _OFFSET.fullmatch(text):
        offset = round(float(match[2]) * _UNITS[match[3]] * _NS)
        return base_ns + offset if match[1] == "+" else end_ns - offset
    try:
        if match := _CLOCK.fullmatch(text):
            return _time_of_day(match, base_ns)
        if match := _ISO.fullmatch(text):
            return _iso(match)
    except ValueError as exc:
        raise ConfigError(f"{text!r} is no time ({exc}): {_EXPECTED}") from None
    raise ConfigError(f"{text!r} is no time: {_EXPECTED}")


def parse_window(
    begin: str | None, end: str | None, first_ns: int | None, last_ns: int | None
) -> TimeWindow:
    """Return the window in a recording; an offset of *end* counts from *begin*.

    Raises:
        ConfigError: one is no time, or the window is empty.
    """
    if first_ns is None or last_ns is None:
        return ALL
    from_ns = None if begin is None else parse_time(begin, first_ns, last_ns)
    base_ns = first_ns if from_ns is None else from_ns
    until_ns = None if end is None else parse_time(end, base_ns, last_ns)
    if from_ns is not None and until_ns is not None and until_ns < from_ns:
        raise ConfigError(f"--until {end} is before --from {begin}")
    return TimeWindow(from_ns, until_ns)


def _fraction(digits: str | None) -> int:
    return int((digits or "").ljust(9, "0"))


def _time_of_day(match: re.Match[str], base_ns: int) -> int:
    base = datetime.fromtimestamp(base_ns // _NS, UTC).astimezone()
    hour, minute, second = int(match[1]), int(match[2]), int(match[3] or 0)
    at = base.replace(hour=hour, minute=minute, second=second, microsecond=0)
    if at < base.replace(second=0, microsecond=0):
        at += timedelta(days=1)
    return int(at.timestamp()) * _NS + _fraction(match[4])


def _iso(match: re.Match[str]) -> int:
    day, hour, minute, second, fraction, zone = match.groups()
    clock = f"{hour or '00'}:{minute or '00'}:{second or '00'}"
    at = datetime.fromisoformat(f"{day}T{clock}{zone or ''}")
    at = at if at.tzinfo else at.astimezone()
    return int(at.timestamp()) * _NS + _fraction(fraction)
