"""Requests of the live view to running appliances; each connects anew: appliances come and go."""

from __future__ import annotations

from typing import Any, NamedTuple

from eap.control.protocol import AnswerT, Method, ParametersT
from eap.control.routes import (
    ROUTES_ADD,
    ROUTES_REMOVE,
    ROUTES_TEST,
    RouterRow,
    TestResult,
)
from eap.errors import EapError
from eap.ops.client import connect_station
from eap.ops.route_lists import list_routes

MOST = 500
"""Routes of a station that are shown; a filter finds the others."""
_REQUESTS = 256
_TEST_MS = 5000
_TEST_S = 10.0


class PlantRouter(NamedTuple):
    """The router of one station, and the plant of its appliance."""

    plant: str
    routes: RouterRow


class Picture(NamedTuple):
    """Content of the view; *problem* says why there is nothing new."""

    routers: list[PlantRouter]
    problem: str = ""


class RouteLink:
    """The running appliances, or the one that runs *plant*."""

    def __init__(self, plant: str | None) -> None:
        self._plant = plant

    def look(self, match: str) -> Picture:
        """Return all routers, with those of their routes that *match*; never raises EapError."""
        try:
            found = list_routes(self._plant, None, match, requests=_REQUESTS, most=MOST)
        except EapError as exc:
            return Picture([], str(exc))
        return Picture([PlantRouter(each.plant, row) for each in found for row in each.stations])

    def add(self, router: PlantRouter, params: dict[str, Any]) -> list[str]:
        """Add a route, and return the warnings; raise EapError if refused."""
        return self._call(router, ROUTES_ADD, **params).warnings

    def remove(self, router: PlantRouter, route: str, transport: str, address: str) -> None:
        """Remove a route; raise EapError if refused."""
        self._call(router, ROUTES_REMOVE, route=route, transport=transport, address=address)

    def test(self, router: PlantRouter, target: str) -> TestResult:
        """Test the way to *target*, which may take some seconds; raise EapError if refused."""
        return self._call(router, ROUTES_TEST, target=target, timeout_ms=_TEST_MS)

    def _call(
        self, router: PlantRouter, method: Method[ParametersT, AnswerT], **params: Any
    ) -> AnswerT:
        station = router.routes.station
        with connect_station(station, router.plant) as client:
            return client.call(method, within_s=_TEST_S, station=station, **params)
