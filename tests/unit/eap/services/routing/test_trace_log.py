"""Log lines of a router."""

from __future__ import annotations

import logging

from msgspec.structs import replace

from eap.ams.record import Outcome, Trace, describe
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, NetId
from eap.services.routing.station_router import TraceLog

HOP = Endpoint("udp:eap0", "10.0.0.2:34980")
FIRST, SECOND = NetId.parse("5.1.1.2.1.1"), NetId.parse("5.1.1.3.1.1")


def trace(
    outcome: Outcome = Outcome.FAILED, *, target: NetId = FIRST, port: int = 10_000,
    connection: str = "10.0.0.9:40000", hop: Endpoint | None = HOP, why: str = "island is down",
) -> Trace:  # fmt: skip
    endpoint = Endpoint("ams-tcp", connection)
    header = AmsHeader(target, port, NetId.parse("10.0.0.9.1.1"), 32_000, 4)
    text = f"{describe(header, endpoint)}: {why}"
    return Trace(0, outcome, endpoint, hop, header, 0x1B, 0, text)


def causes(caplog, *traces: Trace) -> int:
    """Return how many causes the lines of some packets have."""
    log = TraceLog("island")
    for each in traces:
        log.write(each)
    assert len(caplog.records) == len(traces)
    return len({record.cause for record in caplog.records})


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
        "WARNING",
        "INFO",
    ]
    assert caplog.messages[0] == (
        "island: READ_STATE of 5.1.1.2.1.1:10000 for 10.0.0.9.1.1:32000 (10.0.0.9:40000 by ams-tcp)"
        ": island is down (0x1b)"
    )


def test_trace_log_hop_that_is_down_is_one_cause_for_all_requests(caplog):
    asked = [
        trace(),
        trace(connection="10.0.0.9:40001"),
        trace(connection="10.0.0.8:1"),
        trace(target=SECOND, port=851),
    ]
    assert causes(caplog, *asked) == 1


def test_trace_log_other_causes_are_distinct(caplog):
    asked = [
        trace(),
        trace(hop=Endpoint("udp:eap0", "10.0.0.3:34980")),
        trace(why="no answer"),
        trace(hop=None),
        trace(hop=None, target=SECOND),
        trace(hop=None, port=851),
        trace(hop=None, connection="10.0.0.8:1"),
        trace(Outcome.DENIED, hop=None),
    ]
    assert causes(caplog, *asked) == len(asked)


def test_trace_log_client_that_connects_again_is_the_same_cause(caplog):
    asked = [trace(Outcome.DENIED, hop=None, connection=f"10.0.0.9:{port}") for port in range(9)]
    assert causes(caplog, *asked) == 1
    assert {record.source for record in caplog.records} == {"island ams-tcp 10.0.0.9"}


def test_trace_log_packet_without_a_request_is_logged(caplog):
    TraceLog("island").write(Trace(0, Outcome.FAILED, None, None, None, 0x1B, 0, "no way"))
    assert caplog.messages == ["island: no way (0x1b)"]


def test_trace_log_answer_without_header_error_has_no_code(caplog):
    caplog.set_level(logging.INFO)
    TraceLog("island").write(replace(trace(Outcome.ANSWERED), error_code=0, text="no way"))
    assert caplog.messages == ["island: no way"]
