"""What the live view asks of running appliances: each time anew, so that they may come and go."""

from __future__ import annotations

from typing import Any, NamedTuple

from eap.appliance.commands.client import connect_station
from eap.appliance.commands.route_lists import list_routes
from eap.appliance.control_routes import RouterRow, TestResult, read_document
from eap.errors import EapError

MOST = 500
"""Routes of a station that are shown; a filter finds the others."""
_REQUESTS = 256
_TEST_MS = 5000
_TEST_PATIENCE_S = 10.0


class Router(NamedTuple):
    """The router of one station, and the plant of its appliance."""

    plant: str
    routes: RouterRow


class Picture(NamedTuple):
    """What there is to see; *problem* says why there is nothing new."""

    routers: list[Router]
    problem: str = ""


class Link:
    """The running appliances, or the one that runs *plant*."""

    def __init__(self, plant: str | None) -> None:
        self._plant = plant

    def look(self, match: str) -> Picture:
        """Return all routers, with those of their routes that *match*; never raises EapError."""
        try:
            found = list_routes(self._plant, None, match, requests=_REQUESTS, most=MOST)
        except EapError as exc:
            return Picture([], str(exc))
        return Picture([Router(each.plant, row) for each in found for row in each.stations])

    def add(self, router: Router, params: dict[str, Any]) -> list[str]:
        """Add a route, and return what there is to say against it; raise EapError if refused."""
        warnings: list[str] = self._ask(router, "routes_add", **params)["warnings"]
        return warnings

    def remove(self, router: Router, route: str, door: str, address: str) -> None:
        """Remove a route; raise EapError if refused."""
        self._ask(router, "routes_remove", route=route, door=door, address=address)

    def test(self, router: Router, target: str) -> TestResult:
        """Ask *target* for its state, which may take some seconds; raise EapError if refused."""
        answer = self._ask(router, "routes_test", target=target, timeout_ms=_TEST_MS)
        return read_document(answer, TestResult)

    def _ask(self, router: Router, method: str, **params: Any) -> Any:
        station = router.routes.station
        with connect_station(station, router.plant) as client:
            return client.request_within(_TEST_PATIENCE_S, method, station=station, **params)
