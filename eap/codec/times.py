"""Times and dates of IEC 61131-3 as TwinCAT stores them: numbers, Python values and texts.

``TIME`` and ``TOD`` count milliseconds, ``DATE`` and ``DT`` seconds since 1970, all in 32 bits; the
L-forms (``LTIME``, ``LTOD``, ``LDATE``, ``LDT``) count nanoseconds in 64 bits.  Dates and times of
day have no zone.

Values are those of :mod:`datetime`, which counts microseconds: an L-form reads as a subclass of
them with up to 999 ``nanoseconds`` more, so that nothing is lost.  A value that is written is cut
to the resolution of its type.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import date, datetime, time, timedelta
from typing import Any, ClassVar, Self

from eap.codec.basetypes import DataType, Integer, Plain, Value
from eap.codec.wire import Buffer

_US, _MS, _S = 1_000, 1_000_000, 1_000_000_000
_DAY = 86_400 * _S
_UNITS = {"d": _DAY, "h": 3_600 * _S, "m": 60 * _S, "s": _S, "ms": _MS, "us": _US, "ns": 1}
_EPOCH = datetime(1970, 1, 1)  # noqa: DTZ001  a controller's time has no zone


class _Long:
    """Part of all values with nanoseconds; they are ordered by their microseconds."""

    def __ne__(self, other: object) -> bool:  # else that of datetime, which knows microseconds
        return not self == other


class LongDuration(_Long, timedelta):
    """A duration with *nanoseconds* (0 to 999) beyond the microseconds."""

    nanoseconds = 0

    @classmethod
    def of(cls, ns: int) -> Self:
        """Return a duration of *ns* nanoseconds."""
        value = cls(microseconds=ns // _US)
        value.nanoseconds = ns % _US
        return value

    @property
    def ns(self) -> int:
        """The whole duration in nanoseconds."""
        return _duration_ns(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, timedelta) and _duration_ns(self) == _duration_ns(other)

    __hash__ = timedelta.__hash__

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.ns,)


class LongTimeOfDay(_Long, time):
    """A time of day with *nanoseconds* (0 to 999) beyond the microseconds."""

    nanoseconds = 0

    @classmethod
    def of(cls, ns: int) -> Self:
        """Return the time *ns* nanoseconds after midnight."""
        value = cls(*_clock(ns))
        value.nanoseconds = ns % _US
        return value

    @property
    def ns(self) -> int:
        """Nanoseconds since midnight."""
        return _time_ns(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, time) and _time_ns(self) == _time_ns(other)

    __hash__ = time.__hash__

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        return type(self).of, (self.ns,)


class LongDateTime(_Long, datetime):
    """A date and time with *nanoseconds* (0 to 999) beyond the microseconds."""

    nanoseconds = 0

    @classmethod
    def of(cls, ns: int) -> Self:
        """Return the time *ns* nanoseconds after the start of 1970."""
        day = _day_of(ns)
        value = cls(day.year, day.month, day.day, *_clock(ns % _DAY))
        value.nanoseconds = ns % _US
        return value

    @property
    def ns(self) -> int:
        """Nanoseconds since the start of 1970."""
        return _datetime_ns(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, datetime) and (
            _datetime_ns(self) == _datetime_ns(other) and other.tzinfo is None
        )

    __hash__ = datetime.__hash__

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        return type(self).of, (self.ns,)


def _clock(ns: int) -> tuple[int, int, int, int]:
    minutes, rest = divmod(ns, 60 * _S)
    return minutes // 60, minutes % 60, rest // _S, rest % _S // _US


def _duration_ns(value: timedelta) -> int:
    whole = (value.days * 86_400 + value.seconds) * _S + value.microseconds * _US
    return whole + getattr(value, "nanoseconds", 0)


def _time_ns(value: time | datetime) -> int:
    seconds = (value.hour * 60 + value.minute) * 60 + value.second
    return seconds * _S + value.microsecond * _US + getattr(value, "nanoseconds", 0)


def _day_of(ns: int) -> date:
    return date.fromordinal(_EPOCH.toordinal() + ns // _DAY)


def _date_ns(value: date) -> int:
    return (value.toordinal() - _EPOCH.toordinal()) * _DAY


def _datetime_ns(value: datetime) -> int:
    return _date_ns(value) + _time_ns(value)


class Timed(Integer, frozen=True):
    """Base of the times: a number whose value is a time, in units of *tick_ns*."""

    tick_ns: int = 1
    prefix: str = ""
    """Before ``#`` in its literals."""
    expected: ClassVar[str]
    """Description of a value, for messages."""

    @property
    def scalar_range(self) -> None:  # type: ignore[override]  # it is no number for users
        """None: links and sources of numbers do not fit."""
        return None

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a time, or of its text, cut to the resolution of the type."""
        ns = self._from_text(value) if isinstance(value, str) else self._to_ns(value)
        largest = (1 << self.bit_length) - 1
        if ns is None or not 0 <= ns // self.tick_ns <= largest:
            low, high = self._show(0), self._show(largest * self.tick_ns)
            raise self._refuse(value, f"{self.expected} from {low} to {high}")
        return (ns // self.tick_ns).to_bytes(self.size, "little")

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Return the time; every number is one."""
        raw = int.from_bytes(buffer[offset : offset + self.size], "little")
        return self._of_ns(raw * self.tick_ns)

    def parse_text(self, text: str) -> Value:
        """Read a literal of IEC 61131-3, or ISO 8601."""
        return self.decode(self.encode(text), 0)

    def to_plain(self, value: Value) -> Plain:
        """Return the literal."""
        return self._show(self._to_ns(value) or 0)

    def _from_text(self, text: str) -> int | None:
        form = text.strip().upper()
        prefix, sign, rest = form.rpartition("#")
        if sign and prefix not in _PREFIXES[self.prefix]:
            return None
        try:
            return self._parse(rest)
        except ValueError:  # such as the 30th of February
            return None

    def _show(self, ns: int) -> str:
        return f"{self.prefix}#{self._text(ns)}"

    # Abstract, as decode and encode are in the base.

    def _to_ns(self, value: Any) -> int | None:
        """Return a value in nanoseconds, None if it is no such time."""
        raise NotImplementedError

    def _of_ns(self, ns: int) -> Value:
        raise NotImplementedError

    def _parse(self, text: str) -> int | None:
        raise NotImplementedError

    def _text(self, ns: int) -> str:
        raise NotImplementedError


_PREFIXES = {
    "T": {"T", "TIME"},
    "LTIME": {"LT", "LTIME", "T", "TIME"},
    "TOD": {"TOD", "TIME_OF_DAY"},
    "LTOD": {"LTOD", "LTIME_OF_DAY", "TOD", "TIME_OF_DAY"},
    "D": {"D", "DATE"},
    "LDATE": {"LD", "LDATE", "D", "DATE"},
    "DT": {"DT", "DATE_AND_TIME"},
    "LDT": {"LDT", "LDATE_AND_TIME", "DT", "DATE_AND_TIME"},
}
"""Prefixes that the literals of a type may have, by the one that is written."""

# The longest units first; at most 20 digits, because int() takes long for many.
_PART = re.compile(r"(\d{1,20})(?:\.(\d{1,20}))?(MS|US|NS|D|H|M|S)_?", re.ASCII)
_ISO_DURATION = re.compile(r"P(\d+D)?(T(?=\d)(\d+H)?(\d+M)?(\d+(\.\d+)?S)?)?", re.ASCII)
_DATE = re.compile(r"(\d{4})-(\d{1,2})-(\d{1,2})", re.ASCII)
_TIME = re.compile(r"(\d{1,2}):(\d{1,2})(?::(\d{1,2})(?:\.(\d{1,9}))?)?", re.ASCII)
_BOTH = re.compile(rf"({_DATE.pattern})[-T_ ]({_TIME.pattern})", re.ASCII)


class Duration(Timed, frozen=True):
    """TIME and LTIME: a ``timedelta``."""

    expected = "a duration such as T#1h30m5s250ms"

    def _to_ns(self, value: Any) -> int | None:
        return _duration_ns(value) if isinstance(value, timedelta) else None

    def _of_ns(self, ns: int) -> Value:
        if self.tick_ns < _US:
            return LongDuration.of(ns)
        return timedelta(microseconds=ns // _US)

    def _parse(self, text: str) -> int | None:
        if text.startswith("P") and _ISO_DURATION.fullmatch(text):
            text = text[1:].replace("T", "")
        total, end, last = 0, 0, _DAY + 1
        while part := _PART.match(text, end):
            unit = _UNITS[part[3].lower()]
            if unit >= last:  # the larger units first, each at most once
                return None
            fraction = part[2] or ""
            total += int(part[1] + fraction) * unit // 10 ** len(fraction)
            end, last = part.end(), unit
        return total if end == len(text) and end else None

    def _text(self, ns: int) -> str:
        parts = []
        for unit, size in _UNITS.items():
            number, ns = divmod(ns, size)
            if number:
                parts.append(f"{number}{unit}")
        return "".join(parts) or "0s"


class TimeOfDay(Timed, frozen=True):
    """TOD and LTOD: a ``time``; numbers beyond a day, which no controller makes, begin again."""

    expected = "a time of day such as TOD#12:30:15.25"

    def _show(self, ns: int) -> str:
        return super()._show(min(ns, _DAY - self.tick_ns))

    def _to_ns(self, value: Any) -> int | None:
        is_local = isinstance(value, time) and value.tzinfo is None
        return _time_ns(value) if is_local else None

    def _of_ns(self, ns: int) -> Value:
        ns %= _DAY
        return LongTimeOfDay.of(ns) if self.tick_ns < _US else time(*_clock(ns))

    def _parse(self, text: str) -> int | None:
        match = _TIME.fullmatch(text)
        return _clock_ns(match.groups()) if match else None

    def _text(self, ns: int) -> str:
        return _clock_text(ns)


class CalendarDate(Timed, frozen=True):
    """DATE and LDATE: a ``date``; a time of day within the number is not shown."""

    expected = "a date such as D#2026-11-23"

    def _to_ns(self, value: Any) -> int | None:
        return _date_ns(value) if isinstance(value, date) else None

    def _of_ns(self, ns: int) -> Value:
        return _day_of(ns)

    def _parse(self, text: str) -> int | None:
        match = _DATE.fullmatch(text)
        return _date_ns(date(*map(int, match.groups()))) if match else None

    def _text(self, ns: int) -> str:
        return _day_of(ns).isoformat()


class DateAndTime(Timed, frozen=True):
    """DT and LDT: a ``datetime`` without a zone."""

    expected = "a date and time without a zone such as DT#2026-11-23-12:30:15"

    def _to_ns(self, value: Any) -> int | None:
        # A time with a zone would have to be converted to that of the controller, which nobody
        # knows.
        is_local = isinstance(value, datetime) and value.tzinfo is None
        return _datetime_ns(value) if is_local else None

    def _of_ns(self, ns: int) -> Value:
        value = LongDateTime.of(ns)
        return value if self.tick_ns < _US else datetime(*value.timetuple()[:6])  # noqa: DTZ001

    def _parse(self, text: str) -> int | None:
        match = _BOTH.fullmatch(text)
        if match is None:
            return None
        clock = _clock_ns(match.groups()[5:])
        day = _date_ns(date(int(match[2]), int(match[3]), int(match[4])))
        return None if clock is None else day + clock

    def _text(self, ns: int) -> str:
        return f"{_day_of(ns).isoformat()}-{_clock_text(ns % _DAY)}"


def _clock_ns(parts: tuple[str | None, ...]) -> int | None:
    """Return the time of day of the texts of hours, minutes, seconds and fraction."""
    hours, minutes, seconds = (int(each or 0) for each in parts[:3])
    if hours > 23 or minutes > 59 or seconds > 59:
        return None
    return ((hours * 60 + minutes) * 60 + seconds) * _S + int((parts[3] or "").ljust(9, "0"))


def _clock_text(ns: int) -> str:
    hours, minutes, seconds, _ = _clock(ns)
    fraction = f".{ns % _S:09}".rstrip("0").rstrip(".")
    return f"{hours:02}:{minutes:02}:{seconds:02}{fraction}"


def _timed(kind: Callable[..., Timed], name: str, bits: int, tick_ns: int, prefix: str) -> Timed:
    # ETG.1020 has no index for them in this form: that of the number.
    code = 0x07 if bits == 32 else 0x1B
    return kind(name, code, bits, bits // 8, tick_ns=tick_ns, prefix=prefix)


TIMES: tuple[DataType, ...] = (
    _timed(Duration, "TIME", 32, _MS, "T"),
    _timed(Duration, "LTIME", 64, 1, "LTIME"),
    _timed(TimeOfDay, "TOD", 32, _MS, "TOD"),
    _timed(TimeOfDay, "LTOD", 64, 1, "LTOD"),
    _timed(CalendarDate, "DATE", 32, _S, "D"),
    _timed(CalendarDate, "LDATE", 64, 1, "LDATE"),
    _timed(DateAndTime, "DT", 32, _S, "DT"),
    _timed(DateAndTime, "LDT", 64, 1, "LDT"),
)
"""All types of this module."""
