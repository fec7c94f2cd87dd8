from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from eap.errors import ConfigError
from eap.recording.window import parse_time, parse_window

S = 1_000_000_000
FIRST = 1_700_000_030 * S  # 2023-11-14T22:13:50Z
LAST = FIRST + 3600 * S


@pytest.fixture(autouse=True)
def _zone(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    ("text", "after_first"),
    [
        ("+30s", 30),
        ("+1.5", 1.5),
        ("+250ms", 0.25),
        ("+2min", 120),
        ("-10s", 3590),
        ("23:14", 10),
        ("23:13", -50),
        ("23:13:51.25", 1.25),
        ("00:00", 2770),
        ("2023-11-14T22:13:51Z", 1),
        ("2023-11-14 23:13:51", 1),
        ("2023-11-14T22:13:51.000000001+00:00", 1.000000001),
        ("2023-11-15", 2770),
    ],
)
def test_time_of_every_form(text: str, after_first: float) -> None:
    assert parse_time(text, FIRST, LAST) == FIRST + round(after_first * S)


@pytest.mark.parametrize("text", ["", "now", "25:00", "12", "+", "2023-13-01", "+3 days"])
def test_text_that_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="is no time"):
        parse_time(text, FIRST, LAST)


def test_offset_of_the_end_counts_from_the_begin() -> None:
    assert parse_window("+10s", "+30s", FIRST, LAST) == (FIRST + 10 * S, FIRST + 40 * S)
    assert parse_window(None, None, FIRST, LAST) == (None, None)
    assert parse_window("12:00", None, None, None) == (None, None)


def test_window_that_ends_before_it_begins_is_refused() -> None:
    with pytest.raises(ConfigError, match="--until -20s is before --from -10s"):
        parse_window("-10s", "-20s", FIRST, LAST)
