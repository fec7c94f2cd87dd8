"""Log handler with limits."""

from __future__ import annotations

import asyncio
import io
import logging
from contextlib import suppress

import pytest

from eap.services import limited_log
from eap.services.limited_log import MAX_CAUSES, PERIOD_S, RATES, LimitedLogHandler, caused_by
from tests.support.virtualtime import run_virtual


class Log:
    """A handler with a clock; *lines* returns what was written since the last call."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._stream = io.StringIO()
        self.handler = LimitedLogHandler(self._stream, clock=lambda: self.now_s)

    def write(self, text: str, cause: object = None, source: str = "10.0.0.5") -> None:
        record = logging.LogRecord("x", logging.WARNING, "", 0, "%s", (text,), None)
        if cause is not None:
            vars(record).update(caused_by(cause, source))
        self.handler.handle(record)

    def lines(self) -> list[str]:
        found = self._stream.getvalue().splitlines()
        self._stream.seek(0)
        self._stream.truncate()
        return found


def test_log_repeats_of_a_cause_are_one_line_a_period() -> None:
    log = Log()
    for number in range(300):
        log.write(f"read {number}: hop is down", "hop")
        log.now_s += 0.2
    assert log.lines() == ["read 0: hop is down"]
    log.handler.write_counted()
    assert log.lines() == ["read 299: hop is down; repeated 299 times in 60 s"]
    log.write("read 300: hop is down", "hop")
    assert log.lines() == [], "it goes on"
    log.now_s += PERIOD_S
    log.write("another", "another hop")
    assert log.lines() == ["read 300: hop is down; repeated once in 60 s", "another"]


def test_log_cause_that_was_quiet_for_a_period_is_written_at_once() -> None:
    log = Log()
    log.write("hop is down", "hop")
    log.now_s += PERIOD_S
    log.write("hop is down", "hop")
    assert log.lines() == ["hop is down"] * 2


def test_log_lines_without_a_cause_are_all_written() -> None:
    log = Log()
    for _ in range(500):
        log.write("connected")
    assert len(log.lines()) == 500


def test_log_source_with_many_causes_hides_no_other() -> None:
    log = Log()
    for number in range(1000):
        log.write(f"refused {number}", number)
    assert len(log.lines()) == RATES.source.burst
    log.write("refused", "other", "10.0.0.6")
    assert log.lines() == ["refused"]
    log.now_s += PERIOD_S
    log.handler.write_counted()
    assert log.lines() == ["refused 999; the last of 980 lines left out in 60 s"]


def test_log_many_sources_are_limited_together() -> None:
    log = Log()
    for number in range(5000):
        log.write("refused", number, f"10.1.{number // 250}.{number % 250}")
    assert len(log.lines()) == RATES.new.burst


def test_log_causes_are_bounded_and_a_forgotten_one_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limited_log, "MAX_CAUSES", 2)
    log = Log()
    for cause in "abbc":
        log.write(cause, cause)
    assert log.lines() == ["a", "b", "c"]
    log.write("d", "d")
    assert log.lines() == ["d", "b; repeated once in 1 s"]
    assert MAX_CAUSES >= 256


def test_log_end_of_the_process_writes_what_was_counted() -> None:
    log = Log()
    for cause in "aab":
        log.write(cause, cause)
    log.handler.close()
    assert log.lines() == ["a", "b", "a; repeated once in 1 s"]


def test_log_serve_writes_what_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limited_log, "_FLUSH_S", 0.001)
    log = Log()
    log.write("a", "a")
    log.write("a", "a")
    log.now_s = PERIOD_S

    async def run() -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(0.1):
                await log.handler.serve()

    run_virtual(run())
    assert log.lines() == ["a", "a; repeated once in 60 s"]
