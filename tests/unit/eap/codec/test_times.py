from __future__ import annotations

import copy
import pickle
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.datatypes import DataType, parse
from eap.codec.times import TIMES, LongDateTime, LongDuration, LongTimeOfDay

DAY_S = 86_400
NOON = datetime(2026, 11, 23, 12, 30, 15)  # noqa: DTZ001  a controller's time has no zone
NOON_S = 20_780 * DAY_S + 45_015


# Encodings of the vendor's tables: milliseconds, seconds since 1970, and nanoseconds in L-forms.
@pytest.mark.parametrize(
    ("text", "number", "value", "literal"),
    [
        ("TIME", 3_723_500, timedelta(seconds=3723.5), "T#1h2m3s500ms"),
        ("TIME", 0, timedelta(), "T#0s"),
        ("TIME", 2**32 - 1, timedelta(milliseconds=2**32 - 1), "T#49d17h2m47s295ms"),
        ("LTIME", 1_000_001_002, LongDuration.of(1_000_001_002), "LTIME#1s1us2ns"),
        ("DATE", 20_780 * DAY_S, date(2026, 11, 23), "D#2026-11-23"),
        ("LDATE", 20_780 * DAY_S * 10**9, date(2026, 11, 23), "LDATE#2026-11-23"),
        ("TOD", 45_015_250, time(12, 30, 15, 250_000), "TOD#12:30:15.25"),
        ("LTOD", 1, LongTimeOfDay.of(1), "LTOD#00:00:00.000000001"),
        ("DT", NOON_S, NOON, "DT#2026-11-23-12:30:15"),
        ("LDT", NOON_S * 10**9 + 7, LongDateTime.of(NOON_S * 10**9 + 7),
         "LDT#2026-11-23-12:30:15.000000007"),
    ],
)  # fmt: skip
def test_time_as_number_value_and_literal(text: str, number: int, value: Any, literal: str) -> None:
    kind = parse(text)
    octets = number.to_bytes(kind.size, "little")
    assert kind.decode(octets, 0) == value
    assert kind.encode(value) == kind.encode(literal) == octets
    assert kind.to_plain(value) == literal
    assert kind.parse_text(literal) == kind.from_plain(literal) == value


@pytest.mark.parametrize(
    ("text", "typed", "literal"),
    [
        ("TIME", "1h2m3.5s", "T#1h2m3s500ms"),
        ("TIME", "time#90m", "T#1h30m"),
        ("TIME", "T#1d_12h", "T#1d12h"),
        ("TIME", "T#1.0005s", "T#1s"),  # cut to milliseconds
        ("TIME", "PT1H2M3.5S", "T#1h2m3s500ms"),
        ("TIME", "P1DT1S", "T#1d1s"),
        ("LTIME", "T#1us1ns", "LTIME#1us1ns"),
        ("LTIME", "LT#0.5ns", "LTIME#0s"),
        ("DATE", "DATE#2026-1-2", "D#2026-01-02"),
        ("DATE", "2026-01-02", "D#2026-01-02"),
        ("TOD", "TIME_OF_DAY#1:2", "TOD#01:02:00"),
        ("TOD", "23:59:59.999", "TOD#23:59:59.999"),
        ("DT", "2026-11-23T12:30:15", "DT#2026-11-23-12:30:15"),
        ("DT", "DATE_AND_TIME#2026-11-23 12:30", "DT#2026-11-23-12:30:00"),
        ("LDT", "DT#2026-11-23-12:30:15.5", "LDT#2026-11-23-12:30:15.5"),
    ],
)
def test_literals_and_iso_are_read(text: str, typed: str, literal: str) -> None:
    kind = parse(text)
    assert kind.to_plain(kind.parse_text(typed)) == literal


@pytest.mark.parametrize(
    ("text", "value", "reason"),
    [
        ("TIME", "soon", "expected a duration such as T#1h30m5s250ms from T#0s to T#49d17h2m47s"),
        ("TIME", "T#50d", "expected a duration"),
        ("TIME", "T#1s1m", "expected a duration"),
        ("TIME", "T#1s1s", "expected a duration"),
        ("TIME", "T#", "expected a duration"),
        ("TIME", "P", "expected a duration"),
        ("TIME", "T#-1s", "expected a duration"),
        ("TIME", "LTIME#1s", "expected a duration"),
        ("TIME", timedelta(seconds=-1), "expected a duration"),
        ("TIME", 5, "expected a duration"),
        ("TIME", "T#" + "9" * 10_000 + "s", "expected a duration"),
        ("DATE", "2026-02-30", "expected a date such as D#2026-11-23"),
        ("DATE", "1969-12-31", "from D#1970-01-01 to D#2106-02-07"),
        ("DATE", time(1), "expected a date"),
        ("TOD", "24:00", "expected a time of day .* to TOD#23:59:59.999"),
        ("TOD", time(1, tzinfo=UTC), "expected a time of day"),
        ("DT", NOON.replace(tzinfo=UTC), "expected a date and time without a zone"),
        ("DT", "2026-11-23T12:30:15Z", "expected a date and time without a zone"),
        ("DT", date(2026, 1, 1), "expected a date and time"),
        ("DT", "2107-01-01-00:00:00", "to DT#2106-02-07-06:28:15"),
    ],
)
def test_what_is_no_time_is_refused(text: str, value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text).encode(value)


@given(st.sampled_from(TIMES), st.integers(0, 2**64 - 1))
def test_any_number_is_a_time_whose_text_is_read_again(kind: DataType, number: int) -> None:
    octets = (number % (1 << kind.bit_length)).to_bytes(kind.size, "little")
    value = kind.decode(octets, 0)
    plain = kind.to_plain(value)
    assert kind.from_plain(plain) == value
    if kind.text not in ("DATE", "LDATE", "TOD", "LTOD"):  # these have numbers beyond their values
        assert kind.encode(value) == octets


@pytest.mark.parametrize(
    ("long", "short"),
    [
        (LongDuration.of(1_000), timedelta(microseconds=1)),
        (LongTimeOfDay.of(1_000), time(0, 0, 0, 1)),
        (LongDateTime.of(1_000), datetime(1970, 1, 1, 0, 0, 0, 1)),  # noqa: DTZ001
    ],
)
def test_long_time_is_one_of_datetime_with_nanoseconds(long: Any, short: Any) -> None:
    more = type(long).of(1_001)
    assert (more.ns, more.nanoseconds) == (1_001, 1)
    assert long == short
    assert hash(long) == hash(short)
    assert more != short
    assert more != long
    assert more != 5
    assert isinstance(more, type(short))
    assert copy.copy(more) == pickle.loads(pickle.dumps(more)) == more


def test_number_beyond_a_day_begins_again() -> None:
    assert parse("TOD").decode((86_400_000 + 1_000).to_bytes(4, "little"), 0) == time(0, 0, 1)
