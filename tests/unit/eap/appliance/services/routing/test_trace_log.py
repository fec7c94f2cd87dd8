"""Log lines of a router."""

from __future__ import annotations

import logging

from eap.aoe.action import Outcome, Trace
from eap.aoe.way import Way
from eap.appliance.services.routing.trace_log import BURST, LINES_PER_S, MAX_CLIENTS, TraceLog


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


def denied(address: str) -> Trace:
    return trace(Outcome.DENIED)._replace(came_by=Way("ams-tcp", address))


def test_a_client_that_goes_on_trying_hides_no_other(caplog):
    log = TraceLog("island")
    for number in range(1000):
        log.write(denied(f"10.0.0.5:{number}"))
    assert len(caplog.messages) == BURST
    log.write(denied("10.0.0.6:1"))
    log.write(trace())
    assert len(caplog.messages) == BURST + 2


def test_clients_are_forgotten(caplog):
    log = TraceLog("island")
    for number in range(3 * MAX_CLIENTS):
        log.write(denied(f"10.0.{number // 250}.{number % 250}:1"))
    assert len(caplog.messages) == 3 * MAX_CLIENTS


def test_what_was_answered_without_an_error_of_the_header_has_no_code(caplog):
    caplog.set_level(logging.INFO)
    TraceLog("island").write(trace(Outcome.ANSWERED)._replace(error_code=0))
    assert caplog.messages == ["island: no way"]
