"""Log lines of a router."""

from __future__ import annotations

import logging

from eap.aoe.action import Outcome, Trace
from eap.appliance.services.routing.trace_log import BURST, LINES_PER_S, TraceLog


def trace(outcome: Outcome = Outcome.FAILED, at_ns: int = 0) -> Trace:
    return Trace(at_ns, outcome, None, None, None, 0x1B, 0, "no way")


def test_each_outcome_has_its_level(caplog):
    caplog.set_level(logging.DEBUG)
    log = TraceLog("island")
    for outcome in Outcome:
        log.write(trace(outcome))
    assert [each.levelname for each in caplog.records] == [
        "INFO",
        "WARNING",
        "WARNING",
        "WARNING",
        "DEBUG",
        "DEBUG",
    ]
    assert set(caplog.messages) == {"island: no way (0x1b)"}


def test_flood_of_errors_is_no_flood_of_lines(caplog):
    log = TraceLog("island")
    for _ in range(1000):
        log.write(trace())
    assert len(caplog.messages) == BURST
    log.write(trace(at_ns=2_000_000_000))
    assert caplog.messages[BURST:] == [
        f"island: {1000 - BURST} more packets met errors",
        "island: no way (0x1b)",
    ]
    for _ in range(1000):
        log.write(trace(at_ns=2_000_000_000))
    assert len(caplog.messages) == BURST + 1 + 2 * LINES_PER_S


def test_what_nobody_wants_to_see_takes_no_room(caplog):
    log = TraceLog("island")
    for _ in range(1000):
        log.write(trace(Outcome.DROPPED))
    log.write(trace())
    assert caplog.messages == ["island: no way (0x1b)"]
