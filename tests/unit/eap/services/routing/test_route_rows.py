from __future__ import annotations

from time import monotonic_ns, time

import pytest
from msgspec.structs import replace

from eap.ams.record import Outcome, Trace, Traffic
from eap.ams.report import ConnectionReport, RouteReport, RouteState
from eap.ams.routes import Origin, Route
from eap.codec.ams import AmsHeader
from eap.control.routes import RoutesListParameters
from eap.ids import Endpoint, NetId
from eap.services.routing.route_rows import (
    MAX_LOOPS,
    connection_row,
    request_row,
    route_findings,
    route_row,
)
from tests.support.ams import Ams
from tests.support.routeviews import Left
from tests.support.virtualtime import run_virtual

FAR = NetId.parse("127.0.9.2.1.1")
HOP = Endpoint("udp:eap0", "127.0.9.2:34980")
TRAFFIC = Traffic(5 * 10**9, 3, 2, 1, 90, 80, 1_500_000, "lost", (FAR,), last_error_ns=6 * 10**9)
HEADER = AmsHeader(FAR, 851, NetId.parse("5.1.1.1.1.1"), 30000, 2)


def row(left: Left, **wanted: object):
    return left.view.row(RoutesListParameters(**wanted))


def loop(text: str) -> Trace:
    return Trace(monotonic_ns(), Outcome.LOOP, None, None, None, 7, 0, text)


def test_router_in_a_row() -> None:
    left = Left()
    found = row(left)
    assert (found.station, found.net_id, found.total) == ("left", "127.0.9.1.1.1", 1)
    (route,) = found.routes
    assert (route.name, route.pattern, route.origin, route.state) == (
        "right", "127.0.9.2.*.*", "derived", "unknown"
    )  # fmt: skip
    assert (route.transport, route.address) == HOP
    assert (found.connections, found.requests, found.warnings) == ([], [], [])


@pytest.mark.parametrize(
    ("match", "names"),
    [
        ("RIGHT", ["right"]), ("added", ["plc"]), ("derived", ["right"]), ("9.9.", ["plc"]),
        ("ams-tcp", ["plc"]), ("10.0.0.9", ["plc"]), ("down", ["plc"]), ("nobody", []),
        ("", ["right", "plc"]),
    ],
)  # fmt: skip
def test_routes_filter_matches_all_shown_texts(match: str, names: list[str]) -> None:
    left = Left()
    plc = Route(
        NetId.parse("9.9.9.9.1.1"), "plc", Endpoint("ams-tcp:10.0.0.9", "10.0.0.9"), Origin.ADDED
    )
    left.router.add_route(plc)
    found = row(left, match=match)
    assert [each.name for each in found.routes] == names
    assert found.total == len(names)
    assert [each.name for each in row(left, match=match, first=1, count=1).routes] == names[1:]


def test_route_findings_name_each_configured_hop_that_is_down() -> None:
    left, other = Left(), Left()
    assert route_findings([left.router, other.router]) == []
    for each in (left, other):
        each.router.hop_down("udp:eap0", "127.0.9.2:34980", "it does not answer")
        gone = Endpoint("ams-tcp:10.0.0.9", "10.0.0.9")
        each.router.add_route(Route(NetId.parse("9.9.9.9.1.1"), "met", gone, Origin.LEARNED))
    (found,) = route_findings([left.router, other.router])
    assert found["severity"] == "warning"
    assert found["where"] == "left, left"
    assert found["what"] == "route to right (127.0.9.2:34980) is down: it does not answer"
    assert found["advice"] == "'eapctl routes test left right' tests it"


def test_warnings_and_loops_are_listed() -> None:
    left = Left()
    shadowed = Route(FAR, "other", Endpoint("udp:eap0", "127.0.9.3:34980"), Origin.ADDED)
    left.router.add_route(shadowed)
    for number in range(MAX_LOOPS + 3):
        left.router.record.add(loop(f"circle {number}"))
    left.router.record.add(loop("circle 1"))
    warnings = row(left).warnings
    assert any("route other" in each and "is not taken" in each for each in warnings)
    assert [each for each in warnings if each.startswith("loop")][:2] == [
        "loop: circle 1", "loop: circle 7"
    ]  # fmt: skip
    assert len([each for each in warnings if each.startswith("loop")]) == MAX_LOOPS
    left.router.remove_route(*shadowed.key)
    assert not [each for each in row(left).warnings if "other" in each]


def test_requests_and_connections_of_a_running_router() -> None:
    async def script() -> Left:
        left = Left()
        packet = Ams("127.0.9.2.2.1:65535", "127.0.0.1.1.1:30000").octets()
        left.router.receive(packet, "udp:eap0", "127.0.0.1:5000")
        return left

    left = run_virtual(script())
    left.router.record.add(loop("later"))
    found = row(left, requests=1)
    assert [each.outcome for each in found.requests] == ["loop"]
    (connection,) = found.connections
    assert connection.net_ids == ["127.0.0.1.1.1"]
    assert row(left, requests=0).requests == []


def test_route_row_has_all_fields() -> None:
    route = Route(
        FAR, "far", HOP, Origin.LEARNED, 6, is_unidirectional=True, expires_at_ns=61 * 10**9,
        real=NetId.parse("9.9.9.9.1.1"), timeout_ns=900_000_000, is_probed=False,
    )  # fmt: skip
    report = RouteReport(route, RouteState.DOWN, "cut", None, TRAFFIC, "press")
    found = route_row(report, 10**9, is_derived=False)
    assert (found.origin, found.state, found.why, found.rtt_us) == ("learned", "down", "cut", None)
    assert (found.expires_s, found.real, found.timeout_ms) == (60, "9.9.9.9.1.1", 900)
    assert (found.unidirectional, found.probed) == (True, False)
    assert (found.requests, found.answers, found.errors) == (3, 2, 1)
    assert (found.octets_out, found.octets_in, found.last_error) == (90, 80, "lost")
    assert route_row(report, 9 * 10**9, is_derived=False).last_error_s == 3
    late = route_row(report._replace(round_trip_ns=1_999), 99 * 10**9, is_derived=True)
    assert (late.rtt_us, late.expires_s, late.origin) == (1, 0, "derived")


def test_connection_row_has_all_fields() -> None:
    found = connection_row(ConnectionReport(HOP, TRAFFIC), 8 * 10**9)
    assert (found.transport, found.address, found.since_s, found.net_ids) == (*HOP, 3, [str(FAR)])
    assert (found.octets_in, found.octets_out, found.took_us) == (90, 80, 1500)
    assert found.last_error_s == 2
    new = replace(TRAFFIC, answers=0, last_error="", last_error_ns=None)
    assert connection_row(ConnectionReport(HOP, new), 8 * 10**9).last_error_s is None
    assert connection_row(ConnectionReport(HOP, new), 8 * 10**9).took_us is None


def test_request_row_has_all_fields() -> None:
    endpoint = Endpoint("ams-tcp", "127.0.0.1:1")
    trace = Trace(10**9, Outcome.ANSWERED, endpoint, HOP, HEADER, 6, 2_000_000, "no such port")
    found = request_row(trace, 4 * 10**9)
    assert abs(time() - 3 - found.at) < 1
    assert (found.service, found.target) == ("READ", "127.0.9.2.1.1:851")
    assert (found.source, found.came_by) == ("5.1.1.1.1.1:30000", "127.0.0.1:1 by ams-tcp")
    assert (found.transport, found.address, found.error, found.took_us) == (*HOP, 6, 2000)
    said = "READ of 127.0.9.2.1.1:851 for 5.1.1.1.1.1:30000 (127.0.0.1:1 by ams-tcp): cut"
    assert request_row(replace(trace, text=said), 4 * 10**9).text == "cut"
    bare = request_row(replace(trace, endpoint=None, hop=None, header=None), 4 * 10**9)
    assert (bare.service, bare.came_by, bare.transport, bare.text) == ("", "", "", "no such port")
