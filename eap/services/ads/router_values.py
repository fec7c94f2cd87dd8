"""What the dictionary of a router shows, from the router that runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from eap.ams.record import Outcome, Stats
from eap.ams.report import ConnectionReport, RouteReport, RouteState
from eap.ams.routes import Route, RouteTable
from eap.errors import ImageError
from eap.ids import InterfaceUri, MacAddr
from eap.od.profiles.router9000 import RouterLive
from eap.pd.spec import PortKind, PortSpec
from eap.runtime.station_image import StationImage
from eap.services.device.station_device import StationDevice

_INTERFACES = Path("/sys/class/net")
_BUS_STATE = "state"
"""Variable of a bus port."""


class ReportingRouter(Protocol):
    """What is needed of the router of a station."""

    @property
    def table(self) -> RouteTable:
        """Its routes."""

    def report(self, route: Route) -> RouteReport:
        """Return what is known of a route."""

    def connections(self) -> list[ConnectionReport]:
        """Return who asks."""

    def stats(self) -> Stats:
        """Return what is going on, and what was."""


class LiveRouter:
    """The values of one station's router.

    Args:
        router: That runs.
        device: The EAP device of the station.
        image: Where the states of buses are.
        ports: Of the station.
    """

    def __init__(
        self,
        router: ReportingRouter,
        device: StationDevice,
        image: StationImage,
        ports: Sequence[PortSpec],
    ) -> None:
        self._router = router
        self._device = device
        self._image = image
        self._ports: Mapping[str, PortSpec] = {port.name: port for port in ports}
        self._routes: tuple[Route, ...] = ()
        self._version = -1

    def number(self, key: RouterLive) -> int:
        """Return what *key* stands for, of the router as a whole."""
        if key is RouterLive.STATE:
            return int(self._device.status.state)
        if key is RouterLive.CONNECTIONS:
            return len(self._router.connections())
        stats = self._router.stats()
        if key in _OUTCOMES:
            return stats.counts[_OUTCOMES[key]]
        return _FIGURES[key](stats)

    def state_of(self, port: str) -> int:
        """Return the state of a port; of a bus without described slaves it is not known."""
        if self._ports[port].kind is PortKind.EAP:
            return int(self._device.status.state)
        with suppress(ImageError):
            return int(self._image.image.read(f"{port}.{_BUS_STATE}"))
        return 0

    def mac_of(self, port: str) -> bytes:
        """Return the MAC address of the Ethernet interface that a port is bound to, if any."""
        uri = InterfaceUri.parse(self._ports[port].interface)
        if uri.scheme == "ethernet":
            with suppress(OSError, ValueError):
                text = (_INTERFACES / uri.host / "address").read_text().strip()
                return bytes(MacAddr.parse(text))
        return bytes(6)

    def routes(self) -> Sequence[Route]:
        """Return all routes in their order."""
        table = self._router.table
        if table.version != self._version:
            self._version = table.version
            self._routes = tuple(table)
        return self._routes

    def of_route(self, key: RouterLive, route: object) -> Any:
        """Return what *key* stands for, of one of the routes."""
        assert isinstance(route, Route)  # noqa: S101  they come from here
        reader = _OF_ROUTE.get(key)
        return _OF_REPORT[key](self._router.report(route)) if reader is None else reader(route)


_OUTCOMES = {
    RouterLive.ANSWERED: Outcome.ANSWERED,
    RouterLive.FAILED: Outcome.FAILED,
    RouterLive.DENIED: Outcome.DENIED,
    RouterLive.LOOPS: Outcome.LOOP,
    RouterLive.LATE: Outcome.LATE,
    RouterLive.DROPPED: Outcome.DROPPED,
}
_FIGURES: dict[RouterLive, Callable[[Stats], int]] = {
    RouterLive.WAITING: lambda stats: stats.in_flight,
    RouterLive.ROUTES: lambda stats: stats.routes,
    RouterLive.SUBSCRIPTIONS: lambda stats: stats.subscriptions,
}
_STATES = {
    RouteState.UNKNOWN: 0,
    RouteState.UP: 1,
    RouteState.DOWN: 2,
    RouteState.CLIENT: 3,
}
_OF_ROUTE: dict[RouterLive, Callable[[Route], Any]] = {
    RouterLive.ROUTE_NET_ID: lambda route: route.net_id,
    RouterLive.ROUTE_OCTETS: lambda route: route.octets,
    RouterLive.ROUTE_NAME: lambda route: route.name,
    RouterLive.ROUTE_TRANSPORT: lambda route: route.hop.transport,
    RouterLive.ROUTE_ADDRESS: lambda route: route.hop.connection,
    RouterLive.ROUTE_ORIGIN: lambda route: int(route.origin),
}
_OF_REPORT: dict[RouterLive, Callable[[RouteReport], Any]] = {
    RouterLive.ROUTE_STATE: lambda report: _STATES[report.state],
    RouterLive.ROUTE_ROUND_TRIP: lambda report: (report.round_trip_ns or 0) // 1000,
    RouterLive.ROUTE_REQUESTS: lambda report: report.traffic.requests,
    RouterLive.ROUTE_ERRORS: lambda report: report.traffic.errors,
    RouterLive.ROUTE_LAST_ERROR: lambda report: report.why or report.traffic.last_error,
}
