from __future__ import annotations

from eap.ads.endpoint import Endpoint
from eap.ams.record import Traffic
from eap.ams.report import Obstacle, RouteState, report_route
from eap.ams.transport_table import Transport
from tests.support.ams import Ams, parse
from tests.support.aoerouter import CLIENT, FAR, FAR_DEVICE, LINK, Station, route

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


def test_door_tells_why_a_route_is_down() -> None:
    station = Station([route(FAR, LINK)])
    station.router.hop_down("link", None, "no carrier", 0)
    assert report(station)[1:4] == (RouteState.DOWN, "no carrier", None)
    station.router.hop_up("link", None)
    assert report(station).state is RouteState.UNKNOWN


def test_route_by_a_door_that_is_not_there_is_down() -> None:
    obstacle = Obstacle(RouteState.DOWN, "this station has no door link")
    found = report_route(route(FAR, LINK), obstacle, None, None, next_name="far")
    assert (found.state, found.why) == (RouteState.DOWN, "this station has no door link")


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


def test_route_of_a_client_is_forgotten_with_its_door() -> None:
    station = Station([route(FAR, LINK, "tool", is_client=True)])
    station.router.hop_down("link", LINK.connection, "refused", 0)
    station.router.remove_transport("link", 0)
    assert report(station)[1:3] == (RouteState.DOWN, "this station has no door link")
    station.router.add_transport(Transport("link"))
    assert report(station).state is RouteState.UNKNOWN
