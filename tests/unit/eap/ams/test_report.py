"""Reports on routes, advice, and hop reports."""

from __future__ import annotations

import pytest

from eap.ams.record import Traffic
from eap.ams.report import (
    MAX_REPORT,
    HopQuestion,
    HopReport,
    Obstacle,
    RouteReport,
    RouteState,
    advise,
    decode_report,
    encode_report,
    report_of,
    report_route,
)
from eap.ams.spec import AccessRule, ObjectRange
from eap.ams.spec import AccessService as Service
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.errors import CodecError
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams, parse
from tests.support.aoerouter import CLIENT, FAR, FAR_DEVICE, LINK, ROUTER, Station, route

TCP = Endpoint("tcp", "1")
ASKED = Ams(FAR_DEVICE, CLIENT)
MS = 1_000_000


def report(station: Station):
    return station.router.report(*station.table)


def test_route_is_unknown_until_something_is_answered() -> None:
    station = Station([route(FAR, LINK)])
    assert report(station)[1:5] == (RouteState.UNKNOWN, "", None, Traffic())
    onward = station.forwarded(ASKED, TCP)
    assert report(station).state is RouteState.UNKNOWN
    station.now_ns = 3 * MS
    station.give(onward.answer(b"", 7), LINK)
    found = report(station)
    assert (found.state, found.round_trip_ns) == (RouteState.UP, 3 * MS)
    assert found.traffic.errors == 1
    assert found.traffic.last_error == (
        f"error 0x7 (no route to that NetID) from to {FAR} ({LINK}) or from behind it"
    )


def test_route_that_is_not_probed_is_unknown_again_after_a_time_out() -> None:
    station = Station([route(FAR, LINK)])
    station.give(station.forwarded(ASKED, TCP).answer(), LINK)
    assert report(station).state is RouteState.UP
    station.forwarded(ASKED, TCP)
    station.router.handle_timeout(5_000 * MS)
    found = report(station)
    assert found.state is RouteState.UNKNOWN
    assert found.traffic.last_error.startswith("no answer from")


def test_probes_measure_the_next_hop() -> None:
    station = Station([route(FAR, LINK)], is_probing=True)
    (probe,) = station.router.handle_timeout(0)
    station.now_ns = 2 * MS
    station.give(parse(*probe.packets).answer(), LINK)
    assert report(station)[1:4] == (RouteState.UP, "", 2 * MS)
    for second in range(1, 5):
        station.router.handle_timeout(second * 1000 * MS)
    assert report(station)[1:4] == (RouteState.DOWN, "it does not answer", None)


def test_report_has_reason_of_transport_for_route_down() -> None:
    station = Station([route(FAR, LINK)])
    station.router.hop_down("link", None, "no carrier", 0)
    assert report(station)[1:4] == (RouteState.DOWN, "no carrier", None)
    station.router.hop_up("link", None)
    assert report(station).state is RouteState.UNKNOWN


def test_report_route_by_missing_transport_is_down() -> None:
    obstacle = Obstacle(RouteState.DOWN, "this station has no transport link")
    found = report_route(route(FAR, LINK), obstacle, None, None, next_name="far")
    assert (found.state, found.why) == (RouteState.DOWN, "this station has no transport link")


def test_route_of_a_client_that_does_not_listen_is_not_down() -> None:
    station = Station([route(FAR, LINK, "tool", is_client=True)])
    station.router.hop_down("link", LINK.connection, "refused", 0)
    assert report(station)[1:4] == (RouteState.CLIENT, "not listening: refused", None)
    assert station.replied(ASKED, TCP)[1].error == 0x1B
    text = f"tool ({LINK}) is a client, not listening: refused"
    assert station.events()[-1][1].endswith(text)


def test_route_of_a_client_that_listens_is_up_and_then_down() -> None:
    station = Station([route(FAR, LINK, "tool", is_client=True)])
    station.router.hop_down("link", LINK.connection, "refused", 0)
    station.router.hop_up("link", LINK.connection)
    station.give(station.forwarded(ASKED, TCP).answer(), LINK)
    assert report(station).state is RouteState.UP
    station.router.hop_down("link", LINK.connection, "refused", 0)
    assert report(station)[1:3] == (RouteState.DOWN, "refused")


def test_report_forgets_client_route_with_its_transport() -> None:
    station = Station([route(FAR, LINK, "tool", is_client=True)])
    station.router.hop_down("link", LINK.connection, "refused", 0)
    station.router.remove_transport("link", 0)
    assert report(station)[1:3] == (RouteState.DOWN, "this station has no transport link")
    station.router.add_transport(Transport("link"))
    assert report(station).state is RouteState.UNKNOWN


TARGET, OWN = NetId.parse(FAR), NetId.parse(ROUTER)
HOP = Endpoint("udp:eap0", "10.0.0.6:34980")
UP = RouteReport(route(FAR, HOP, "island"), RouteState.UP, "", 1, Traffic(), "island")
DOWN = UP._replace(state=RouteState.DOWN, why="it does not answer")


def test_answers_are_answers() -> None:
    assert advise(0, TARGET, UP, OWN, is_own=False)[:2] == (True, "answers")
    found = advise(AdsError.TARGET_PORT, TARGET, UP, OWN, is_own=False)
    assert found[:2] == (True, "is there; error 0x6 (nothing has that AMS port)")


CLIENT_ADVICE = UP._replace(state=RouteState.CLIENT, why="not listening: refused")
BEYOND = DOWN._replace(next_name="near")


@pytest.mark.parametrize(
    ("error", "report", "text", "hint"),
    [
        (7, None, f"there is no route to {FAR}", "eapctl routes add"),
        (0x1B, DOWN, f"island ({HOP}) is down: it does not answer", "in the same network"),
        (0x1B, BEYOND, f"near ({HOP}) is down: it does not answer", "in the same network"),
        (
            0x1B,
            CLIENT_ADVICE,
            f"island ({HOP}) is a client, not listening: refused",
            "nothing is wrong",
        ),
        (0x1B, UP, f"host unreachable behind island ({HOP})", "eapctl trace"),
        (0x719, UP, f"no answer from island ({HOP}) in time", f"add one to {ROUTER}"),
        (7, UP, f"island ({HOP}) has no route to {FAR}", f"needs a route to {FAR}"),
        (0x723, UP, "access rules forbid to ask for its state", "under access in the plant"),
    ],
)
def test_advice_has_error_and_hint(
    error: int, report: RouteReport | None, text: str, hint: str
) -> None:
    found = advise(error, TARGET, report, OWN, is_own=False)
    assert (found.is_reached, found.text) == (False, text)
    assert hint in found.hint


def test_advice_has_other_errors_unchanged() -> None:
    found = advise(0x701, TARGET, UP, OWN, is_own=False)
    assert found.text == (
        f"island ({HOP}) or a station behind it answers: error 0x701"
        " (it does not know that service)"
    )
    found = advise(4, TARGET, None, OWN, is_own=True)
    assert found.text.startswith("this station itself answers: error 0x4")


LAPTOP = Endpoint("tcp", "10.0.0.5:49152")
SOURCE = NetId.parse("192.168.0.9.1.1")


def ask(station: Station, net_id: str, port: int, endpoint: Endpoint = LAPTOP) -> HopReport:
    target = NetId.parse(net_id)
    location = station.router.locate(AmsHeader(target, port, SOURCE, 1, 4), endpoint)
    return report_of("island", NetId.parse(ROUTER), target, location, station.now_ns)


def test_question_on_the_wire() -> None:
    question = HopQuestion(NetId.parse(FAR), 1001, 2)
    assert question.encode() == bytes.fromhex("060101010101 e903 02 00")


def test_hop_report_of_local_address() -> None:
    here = ask(Station(rules=()), "5.1.1.1.2.1", 0xFFFF)
    assert (here.station, here.net_id, here.is_here, here.why) == ("island", ROUTER, True, "")
    assert here.may[Service.READ] is True
    assert here.may[Service.WRITE] is False
    missing = ask(Station(), "5.1.1.1.2.1", 7)
    assert missing.why == "nothing has port 7 of 5.1.1.1.2.1"


def test_hop_report_of_routed_address() -> None:
    objects = AccessRule("objects", objects=(ObjectRange(0x8000, 0x8000),))
    near = NetId.parse("6.2.2.2.1.1")
    far = route("10.6.6.6.1.1", LINK, "far", router=near, real=NetId.parse(FAR))
    onward = ask(Station([far], rules=(objects,)), "10.6.6.6.3.1", 1001)
    assert (onward.is_here, onward.route, onward.next_net_id) == (False, "far", str(near))
    assert (onward.transport, onward.address, onward.state, onward.why) == (*LINK, "unknown", "")
    assert onward.target == "6.1.1.1.3.1"
    assert onward.may[Service.WRITE] is None


def test_hop_report_has_reason_without_route() -> None:
    station = Station([route(FAR, LINK, "far")])
    assert ask(station, "9.9.9.9.1.1", 1).why == "no route to 9.9.9.9.1.1"
    back = ask(station, FAR, 1, LINK)
    assert (back.route, back.why) == ("far", "route far leads back to where it came from")
    station.router.hop_down(*LINK, "cable pulled", 1)
    down = ask(station, FAR, 1)
    assert (down.state, down.why) == ("down", "far (10.0.0.6 by link) is down: cable pulled")


def test_reports_survive_the_wire() -> None:
    report = ask(Station([route(FAR, LINK, "far")]), FAR, 1)
    data = encode_report(report)
    assert len(data) < MAX_REPORT
    assert decode_report(data) == report


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff",
        b"[]",
        b'{"station": "x", "net_id": "1.2"}',
        b'{"station": 5}',
        b'{"station": "\\u001b[2J", "net_id": "1.2.3.4.5.6"}',
        b'{"station": "\xff"}',
        b'{"later": ' + b"[" * 1500,
    ],
)
def test_hop_report_refuses_malformed_data(data: bytes) -> None:
    with pytest.raises(CodecError):
        decode_report(data)
