"""Methods of the control protocol about routes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import Any

from eap.ams.directory import Directory, parse_via
from eap.ams.spec import RouteSpec, TransportKind
from eap.codec import staticroutes
from eap.codec.ads import AdsError
from eap.codec.ams import AMS_TCP_PORT
from eap.codec.staticroutes import TCP_IP, StaticRoute
from eap.control import routes as words
from eap.control.protocol import ErrorCode, of_station, unless_unavailable
from eap.errors import ControlError
from eap.ids import NetId
from eap.services.routing.remote_routers import (
    FoundRouter,
    RemoteRouteRequest,
    add_remote_route,
    scan_routers,
)
from eap.services.routing.route_rows import RouterView, route_row
from eap.services.routing.tracing import find_target, probe_target
from eap.suggest import suggest

_ANY = NetId(bytes(6))
"""Stands in a default route."""
_USUAL_PORT = f":{AMS_TCP_PORT}"


class RouteMethods:
    """What can be asked about the routers of all stations here.

    Args:
        views: The routers by the names of their stations.
        directory: Of the plant.
    """

    def __init__(self, views: Mapping[str, RouterView], directory: Directory) -> None:
        self._views = views
        self._directory = directory

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                words.ROUTES_LIST.served_by(self._list),
                words.ROUTES_ADD.served_by(self._add),
                words.ROUTES_REMOVE.served_by(self._remove),
                words.ROUTES_ADD_REMOTE.served_by(self._add_remote),
                words.ROUTES_SCAN.served_by(self._scan),
                words.ROUTES_TEST.served_by(self._test),
                words.ROUTES_IMPORT.served_by(self._import),
                words.ROUTES_EXPORT.served_by(self._export),
            )
        )

    def _list(self, wanted: words.RoutesListParameters) -> list[words.RouterRow]:
        views = [self._view(wanted.station)] if wanted.station else self._views.values()
        return [view.row(wanted) for view in views]

    async def _add(self, wanted: words.RoutesAddParameters) -> words.AddedRoute:
        view = self._view(wanted.station)
        row = await self._take(view, wanted)
        warnings = [text for text in view.warnings() if f"route {row.name} " in text]
        return words.AddedRoute(route=row, warnings=warnings)

    async def _remove(self, wanted: words.RoutesRemoveParameters) -> words.RouteAnswer:
        routes = self._view(wanted.station).routes
        with unless_unavailable():
            spec = await routes.remove(
                wanted.route, transport=wanted.transport, address=wanted.address
            )
        return words.RouteAnswer(route=_removed(spec))

    async def _test(self, wanted: words.RoutesTestParameters) -> words.TestResult:
        router = self._view(wanted.station).router
        target = find_target(router, self._directory, wanted.target)
        return await probe_target(router, target, wanted.timeout_ms / 1000)

    async def _scan(self, wanted: words.RoutesScanParameters) -> list[words.NeighbourRow]:
        if wanted.address:
            _address(wanted.address)
        if wanted.station:
            return await self._scan_from(self._view(wanted.station), wanted)
        views = [view for view in self._views.values() if view.routes.scanners]
        rows = await asyncio.gather(*(self._scan_from(view, wanted) for view in views))
        return [row for each in rows for row in each]

    async def _add_remote(self, wanted: words.RoutesAddRemoteParameters) -> words.RemoteRouteResult:
        view, address = self._view(wanted.station), _address(wanted.address)
        name = wanted.name or view.router.name
        if "\0" in name + wanted.user + wanted.password:
            raise ControlError("a NUL in a text", code=ErrorCode.VALUE)
        route = RemoteRouteRequest(name, view.router.net_id, wanted.user, wanted.password)
        with unless_unavailable():
            result = await add_remote_route(view.routes, route, address, wanted.wait_ms / 1000)
        if result is None:
            return words.RemoteRouteResult(ok=False, result=None, text="no answer by UDP 48899")
        text = "added" if result == AdsError.NONE else AdsError.words_of(result)
        return words.RemoteRouteResult(ok=result == AdsError.NONE, result=result, text=text)

    async def _scan_from(
        self, view: RouterView, wanted: words.RoutesScanParameters
    ) -> list[words.NeighbourRow]:
        with unless_unavailable():
            found = await scan_routers(view.routes, wanted.address, wanted.wait_ms / 1000)
        return [_neighbour_row(view, each) for each in found]

    async def _import(self, wanted: words.RoutesImportParameters) -> list[words.ImportRow]:
        view = self._view(wanted.station)
        try:
            found = staticroutes.parse(wanted.xml)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        rows = []
        for route in found:
            rows.append(await self._import_one(view, route, dry_run=wanted.dry_run))
            await asyncio.sleep(0)  # others have their turns between
        return rows

    def _export(self, wanted: words.RoutesExportParameters) -> words.Export:
        view = self._view(wanted.station)
        routes, left_out = [], []
        for route in view.router.table:
            is_plain = route.octets and route.real is None
            if is_plain and route.hop.kind == TransportKind.AMS_TCP:
                address = route.hop.connection.removesuffix(_USUAL_PORT)
                routes.append(StaticRoute(route.name, str(route.net_id), address))
            else:
                left_out.append(route.name)
        router = view.router
        xml = staticroutes.dump(router.name, str(router.net_id), routes, tcp_port=AMS_TCP_PORT)
        return words.Export(xml=xml, left_out=list(dict.fromkeys(left_out)))

    async def _import_one(
        self, view: RouterView, route: StaticRoute, *, dry_run: bool
    ) -> words.ImportRow:
        via, reason = f"{TransportKind.AMS_TCP}:{route.address}", ""
        wanted = words.RoutesAddParameters(
            station=view.router.name, name=route.name, net_id=route.net_id, via=via
        )
        if route.type != TCP_IP:
            reason = f"its type is {route.type!r}, expected {TCP_IP}"
        elif not route.address or not route.net_id or not route.name:
            reason = "it lacks Name, NetId or Address"
        else:
            try:
                if dry_run:
                    view.routes.check(self._spec(wanted))
                else:
                    await self._take(view, wanted)
            except ControlError as exc:
                reason = str(exc)
        return words.ImportRow(name=route.name, net_id=route.net_id, via=via, reason=reason)

    async def _take(self, view: RouterView, wanted: words.RoutesAddParameters) -> words.RouteRow:
        spec = self._spec(wanted)
        with unless_unavailable():
            route = await view.routes.add(spec, replaces=wanted.replaces)
        return route_row(view.router.report(route), monotonic_ns(), is_derived=False)

    def _spec(self, wanted: words.RoutesAddParameters) -> RouteSpec:
        """Return the route that is wanted; raise ControlError if there cannot be one."""
        try:
            net_id = self._net_id(wanted)
            hop = parse_via(
                wanted.via, net_id, self._directory.stations[wanted.station], self._directory,
                port=wanted.port,
            )  # fmt: skip
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        beside = self._directory.stations.get(wanted.via.partition("/")[0])
        return RouteSpec(
            name=wanted.name,
            net_id=net_id,
            hop=hop,
            octets=wanted.octets,
            router=str(beside.net_id) if beside else "",
            virtual=wanted.virtual,
            is_unidirectional=wanted.unidirectional,
            timeout_ms=wanted.timeout_ms,
            is_probed=wanted.probed,
        )

    def _net_id(self, wanted: words.RoutesAddParameters) -> str:
        """Return the NetID of a route; raise ValueError if there is none."""
        stations = self._directory.stations
        if wanted.net_id:
            return str(NetId.parse(wanted.net_id))
        if not wanted.octets:
            return str(_ANY)
        if wanted.name in stations:
            return str(stations[wanted.name].net_id)
        raise ValueError(
            f"a NetID is needed: {wanted.name!r} is no station of the plant"
            f"{suggest(wanted.name, stations)}"
        )

    def _view(self, station: str) -> RouterView:
        return of_station(station, self._views)


def _neighbour_row(view: RouterView, found: FoundRouter) -> words.NeighbourRow:
    name, net_id, address, version = found.neighbour
    route = view.router.table.find(net_id)
    is_own = route is not None and route[1] > 0  # a default route leads anywhere
    return words.NeighbourRow(
        station=view.router.name,
        name=name,
        net_id=str(net_id),
        address=address,
        version=version,
        route=route[0].name if route is not None and is_own else "",
        is_learned=found.is_learned,
    )


def _address(text: str) -> IPv4Address:
    try:
        return IPv4Address(text)
    except ValueError as exc:
        raise ControlError(f"address: {exc}", code=ErrorCode.VALUE) from None


def _removed(spec: RouteSpec) -> words.RouteRow:
    kind, port, address = spec.hop.kind, spec.hop.port, spec.hop.address
    return words.RouteRow(
        name=spec.name,
        net_id=spec.virtual or spec.net_id,
        octets=spec.octets,
        transport=f"{kind}:{port}" if port else kind,
        address=address,
        origin="added",
        state="down",
        why="removed",
        next_name=spec.name,
        real=spec.net_id if spec.virtual else "",
        unidirectional=spec.is_unidirectional,
        timeout_ms=spec.timeout_ms,
        probed=spec.is_probed,
    )
