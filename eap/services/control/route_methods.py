"""Methods of the control protocol for routes, AMS requests and the configuration of routers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import Any

import msgspec

from eap.ams.directory import AmsAddress, Directory, parse_via
from eap.ams.spec import MqttSpec, RouteSpec, SecureRouteSpec, TransportKind
from eap.codec import staticroutes
from eap.codec.ads import AdsError
from eap.codec.ams import AMS_TCP_PORT
from eap.codec.staticroutes import TCP_IP, StaticBroker, StaticRoute
from eap.codec.tlshandshake import parse_fingerprint
from eap.control import device as device_records
from eap.control import routes as records
from eap.control.bus import to_octets
from eap.control.device import RoutingDifference
from eap.control.protocol import ErrorCode, WriteOrigin, of_station, unless_unavailable
from eap.errors import ControlError
from eap.ids import NetId
from eap.services.routing.remote_routers import (
    FoundRouter,
    RemoteRouteRequest,
    add_remote_route,
    scan_routers,
)
from eap.services.routing.route_rows import RouterView, route_row
from eap.services.routing.scanning import scan, scan_targets
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routing import StationRouting
from eap.services.routing.tracing import NO_SLAVE, TraceResult, find_target, probe_target, trace
from eap.suggest import suggest

_NS_PER_US = 1000


class AmsMethods:
    """Answers by the routers of all stations of the appliance.

    Args:
        routers: By station.
        directory: Names of the plant.
        address_of: Returns where a station is reached by AMS/TCP; empty if it is not.
        deny_control: Returns the reason that a user of a bridge may not control a device by a
            station's router, empty if it may.
    """

    def __init__(
        self,
        routers: Mapping[str, StationRouter],
        directory: Directory,
        address_of: Callable[[str], str],
        deny_control: Callable[[str, WriteOrigin], str] = lambda *_: "",
    ) -> None:
        self._routers = routers
        self._directory = directory
        self._address_of = address_of
        self._deny_control = deny_control

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name; all have to be waited for.

        Raises:
            ControlError: (every method) there is no such station or target.
        """
        return dict(
            (
                records.SCAN.served_by(self._scan),
                records.TRACE.served_by(self._trace),
                records.AMS_ASK.served_by(self._ask),
            )
        )

    async def _scan(self, wanted: records.ScanParameters) -> records.PlantScan:
        router = self._router(wanted.via)
        stations = await scan(router, scan_targets(self._directory, router.table))
        via = records.ScanVia(router.name, self._address_of(router.name))
        return records.PlantScan(stations, via)

    async def _trace(self, wanted: records.TraceParameters) -> records.TracedPath:
        router, address = self._router(wanted.via), _resolve(self._directory.find, wanted.target)
        found = await trace(router, *address)
        return records.TracedPath(
            wanted.target,
            str(address),
            self._directory.name_of(*address),
            not found.why,
            found.why,
            _hop_rows(found),
            _target_answer(found),
        )

    async def _ask(self, wanted: records.AskParameters) -> records.AmsReply:
        find = self._directory.find_device if wanted.device else self._directory.find
        router, address = self._router(wanted.via), _resolve(find, wanted.target)
        if wanted.origin is not None and (why := self._deny_control(router.name, wanted.origin)):
            raise ControlError(f"station {router.name}: {why}", code=ErrorCode.REFUSED)
        timeout_s = wanted.timeout_ms / 1000
        data = to_octets(wanted.data)
        answer = await router.request(*address, wanted.command, data, timeout_s=timeout_s)
        return records.AmsReply(answer.error_code, answer.data.hex())

    def _router(self, via: str) -> StationRouter:
        return of_station(via or next(iter(self._routers)), self._routers)


def _resolve(find: Callable[[str], AmsAddress], target: str) -> AmsAddress:
    try:
        return find(target)
    except ValueError as exc:
        raise _unknown_target(str(exc)) from None


def _hop_rows(found: TraceResult) -> list[records.HopRow]:
    rows, before_us = [], 0
    for hop in found.hops:
        took_us = hop.took_ns // _NS_PER_US
        spent_us = max(0, took_us - before_us)
        rows.append(records.hop_row(hop.report, took_us, spent_us, is_opaque=hop.is_opaque))
        before_us = took_us
    return rows


def _target_answer(found: TraceResult) -> records.TargetAnswer | None:
    if found.answer is None:
        return None
    states, result = found.states, found.answer.result
    is_missing = found.why.endswith(NO_SLAVE)
    return records.TargetAnswer(
        result,
        AdsError.words_of(result) if result else NO_SLAVE if is_missing else "",
        None if states is None else states.ads_state,
        None if states is None else states.device_state,
        found.took_ns // _NS_PER_US,
    )


def _unknown_target(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)


_ANY = NetId(bytes(6))
"""Stands in a default route."""
_USUAL_PORT = f":{AMS_TCP_PORT}"


class RouteMethods:
    """Methods for the routes of all stations of the appliance.

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
                records.ROUTES_LIST.served_by(self._list),
                records.ROUTES_ADD.served_by(self._add),
                records.ROUTES_REMOVE.served_by(self._remove),
                records.ROUTES_ADD_REMOTE.served_by(self._add_remote),
                records.ROUTES_SCAN.served_by(self._scan),
                records.ROUTES_TEST.served_by(self._test),
                records.ROUTES_IMPORT.served_by(self._import),
                records.ROUTES_EXPORT.served_by(self._export),
            )
        )

    def _list(self, wanted: records.RoutesListParameters) -> list[records.RouterRow]:
        views = [self._view(wanted.station)] if wanted.station else self._views.values()
        return [view.row(wanted) for view in views]

    async def _add(self, wanted: records.RoutesAddParameters) -> records.AddedRoute:
        view = self._view(wanted.station)
        row = await self._take(view, self._spec(wanted), wanted.replaces)
        warnings = [text for text in view.warnings() if f"route {row.name} " in text]
        return records.AddedRoute(route=row, warnings=warnings)

    async def _remove(self, wanted: records.RoutesRemoveParameters) -> records.RouteAnswer:
        routes = self._view(wanted.station).routes
        with unless_unavailable():
            spec = await routes.remove(
                wanted.route, transport=wanted.transport, address=wanted.address
            )
        return records.RouteAnswer(route=_removed(spec))

    async def _test(self, wanted: records.RoutesTestParameters) -> records.TestResult:
        router = self._view(wanted.station).router
        target = find_target(router, self._directory, wanted.target)
        return await probe_target(router, target, wanted.timeout_ms / 1000)

    async def _scan(self, wanted: records.RoutesScanParameters) -> list[records.NeighbourRow]:
        if wanted.address:
            _address(wanted.address)
        if wanted.station:
            return await self._scan_from(self._view(wanted.station), wanted)
        views = [view for view in self._views.values() if view.routes.scanners]
        rows = await asyncio.gather(*(self._scan_from(view, wanted) for view in views))
        return [row for each in rows for row in each]

    async def _add_remote(
        self, wanted: records.RoutesAddRemoteParameters
    ) -> records.RemoteRouteResult:
        view, address = self._view(wanted.station), _address(wanted.address)
        name = wanted.name or view.router.name
        # Texts of the UDP service end with a NUL: one inside would truncate them silently.
        if "\0" in name + wanted.user + wanted.password:
            raise ControlError("NUL in name, user or password", code=ErrorCode.VALUE)
        if wanted.tls:
            return await _add_remote_by_tls(view, wanted, name)
        route = RemoteRouteRequest(name, view.router.net_id, wanted.user, wanted.password)
        with unless_unavailable():
            result = await add_remote_route(
                view.routes.scanners, route, address, wanted.wait_ms / 1000
            )
        if result is None:
            return records.RemoteRouteResult(ok=False, result=None, text="no answer by UDP 48899")
        text = "added" if result == AdsError.NONE else AdsError.words_of(result)
        return records.RemoteRouteResult(ok=result == AdsError.NONE, result=result, text=text)

    async def _scan_from(
        self, view: RouterView, wanted: records.RoutesScanParameters
    ) -> list[records.NeighbourRow]:
        with unless_unavailable():
            routes = view.routes
            found = await scan_routers(
                routes.scanners, routes.learn, wanted.address, wanted.wait_ms / 1000
            )
        return [_neighbour_row(view, each) for each in found]

    async def _import(self, wanted: records.RoutesImportParameters) -> list[records.ImportRow]:
        view = self._view(wanted.station)
        try:
            found = staticroutes.parse(wanted.xml)
        except ValueError as exc:
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        rows = []
        for route in found.routes:
            rows.append(await self._import_one(view, route, dry_run=wanted.dry_run))
            await asyncio.sleep(0)  # others have their turns between
        networks = {each.network for each in view.routes.spec.mqtt}
        rows += [_broker_row(each, networks) for each in found.brokers]
        return rows

    def _export(self, wanted: records.RoutesExportParameters) -> records.Export:
        view = self._view(wanted.station)
        routes, left_out = [], []
        added = {(each.net_id, each.octets): each for each in view.routes.added}
        for route in view.router.table:
            # StaticRoutes files know neither default routes nor virtual NetIDs.
            is_plain = route.octets and route.real is None
            if is_plain and route.hop.kind == TransportKind.AMS_TCP:
                kept = added.get((str(route.net_id), route.octets))
                routes.append(
                    StaticRoute(
                        route.name,
                        str(route.net_id),
                        route.hop.connection.removesuffix(_USUAL_PORT),
                        flags=kept.file_flags if kept else "",
                        timeout=kept.file_timeout if kept else "",
                        is_unidirectional=route.is_unidirectional,
                    )
                )
            elif route.hop.kind != TransportKind.MQTT:
                left_out.append(route.name)
        router = view.router
        brokers = [_static_broker(each) for each in view.routes.spec.mqtt]
        xml = staticroutes.dump(
            router.name, str(router.net_id), routes, brokers, tcp_port=AMS_TCP_PORT
        )
        return records.Export(xml=xml, left_out=list(dict.fromkeys(left_out)))

    async def _import_one(
        self, view: RouterView, route: StaticRoute, *, dry_run: bool
    ) -> records.ImportRow:
        secure = view.routes.spec.secure
        by_authority = route.security == "Tls" and route.has_ca and bool(secure and secure.ca)
        kind = TransportKind.AMS_TLS if by_authority else TransportKind.AMS_TCP
        via, reason = f"{kind}:{route.address}", ""
        wanted = records.RoutesAddParameters(
            station=view.router.name,
            name=route.name,
            net_id=route.net_id,
            via=via,
            unidirectional=route.is_unidirectional,
            check_name=not route.ignores_name,
        )
        if route.security and not by_authority:
            # Without it the packets would cross the network in clear text.
            reason = (
                f"it is protected by {route.security}: add it with 'eapctl routes add --via"
                f" ams-tls:{route.address}', or with tls to the plant file"
            )
        elif route.type != TCP_IP:
            reason = f"its type is {route.type!r}, expected {TCP_IP}"
        elif not route.address or not route.net_id or not route.name:
            reason = "it lacks Name, NetId or Address"
        else:
            try:
                spec = msgspec.structs.replace(
                    self._spec(wanted), file_flags=route.flags, file_timeout=route.timeout
                )
                if dry_run:
                    view.routes.check(spec)
                else:
                    await self._take(view, spec)
            except ControlError as exc:
                reason = str(exc)
        note = "" if reason else _kept_note(route)
        return records.ImportRow(
            name=route.name, net_id=route.net_id, via=via, reason=reason, note=note
        )

    async def _take(
        self, view: RouterView, spec: RouteSpec, replaces: str = ""
    ) -> records.RouteRow:
        with unless_unavailable():
            route = await view.routes.add(spec, replaces=replaces)
        return route_row(view.router.report(route), monotonic_ns(), is_derived=False)

    def _spec(self, wanted: records.RoutesAddParameters) -> RouteSpec:
        """Return the route that is wanted; raise ControlError if there cannot be one."""
        try:
            net_id = self._net_id(wanted)
            hop = parse_via(
                wanted.via, net_id, self._directory.stations[wanted.station], self._directory,
                port=wanted.port,
            )  # fmt: skip
            tls = self._tls(wanted, hop.kind)
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
            tls=tls,
        )

    def _tls(
        self, wanted: records.RoutesAddParameters, kind: TransportKind
    ) -> SecureRouteSpec | None:
        """Return TLS of a route; raise ValueError if it cannot work."""
        if kind is not TransportKind.AMS_TLS:
            if wanted.fingerprint:
                raise ValueError(f"a fingerprint is for ams-tls:HOST, not for {wanted.via}")
            return None
        own = self._view(wanted.station).routes.spec.secure
        if own is None:
            raise ValueError(
                f"station {wanted.station} has no certificate for {wanted.via}: write secure_ads"
                " into the plant file"
            )
        if not wanted.fingerprint and not own.ca:
            raise ValueError(
                f"{wanted.via} needs a fingerprint: secure_ads of {wanted.station} has no ca"
            )
        fingerprint = parse_fingerprint(wanted.fingerprint) if wanted.fingerprint else ""
        return SecureRouteSpec(fingerprint=fingerprint, check_name=wanted.check_name)

    def _net_id(self, wanted: records.RoutesAddParameters) -> str:
        """Return the NetID of a route; raise ValueError if there is none."""
        stations = self._directory.stations
        if wanted.net_id:
            return str(NetId.parse(wanted.net_id))
        # A default route matches every NetID: it needs none of its own.
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


async def _add_remote_by_tls(
    view: RouterView, wanted: records.RoutesAddRemoteParameters, name: str
) -> records.RemoteRouteResult:
    """Request a route by Secure ADS."""
    # Imported here: few plants have it.
    from eap.services.transports.secure_ads import SecureOpenError, request_route

    own = view.routes.spec.secure
    if own is None or not (wanted.fingerprint or own.ca):
        missing = "a fingerprint, or secure_ads with a ca" if own else "secure_ads"
        raise ControlError(f"station {wanted.station} needs {missing}", code=ErrorCode.VALUE)
    try:
        fingerprint = parse_fingerprint(wanted.fingerprint) if wanted.fingerprint else ""
    except ValueError as exc:
        raise ControlError(str(exc), code=ErrorCode.VALUE) from None
    spec = SecureRouteSpec(fingerprint=fingerprint).complete(own)
    login = wanted.user, wanted.password
    try:
        async with asyncio.timeout(wanted.wait_ms / 1000):
            await request_route(spec, wanted.address, (view.router.net_id, name), login)
    except TimeoutError:
        return records.RemoteRouteResult(ok=False, result=None, text="no answer by TCP 8016")
    except SecureOpenError as exc:
        return records.RemoteRouteResult(ok=False, result=None, text=str(exc))
    return records.RemoteRouteResult(ok=True, result=0, text="added")


def _kept_note(route: StaticRoute) -> str:
    """Return a note on what is kept for an export and has no effect."""
    kept = [f"Flags {route.flags}"] if route.flags else []
    kept += [f"Timeout {route.timeout}"] if route.timeout else []
    return f"{' and '.join(kept)} kept for an export, without effect" if kept else ""


def _broker_row(broker: StaticBroker, networks: set[str]) -> records.ImportRow:
    """Return the row of a broker, which only a plant file can add."""
    via, reason = f"{TransportKind.MQTT}:{broker.topic}", ""
    if broker.topic not in networks:
        scheme = "mqtts" if broker.has_tls or broker.has_psk else "mqtt"
        keys = [
            f'mqtt: "{scheme}://{broker.address}:{broker.port}"',
            f"network: {broker.topic}",
            *((f"user: {broker.user}",) if broker.user else ()),
            *(("unidirectional: true",) if broker.is_unidirectional else ()),
        ]
        needed = [
            *(("password_file",) if broker.user else ()),
            *(("tls with ca, certificate and key",) if broker.has_tls else ()),
        ]
        reason = f"a broker belongs to the plant file: - {{{', '.join(keys)}}}"
        reason += f"; write {' and '.join(needed)} too" if needed else ""
        if broker.has_psk:
            reason += "; pre-shared keys are not supported, use certificates"
    return records.ImportRow(name=broker.topic, net_id="", via=via, reason=reason)


def _static_broker(spec: MqttSpec) -> StaticBroker:
    tls = spec.tls
    return StaticBroker(
        spec.host,
        spec.port,
        spec.network,
        spec.user,
        tls.ca if tls else "",
        tls.certificate if tls else "",
        has_tls=tls is not None,
        is_unidirectional=spec.is_unidirectional,
    )


def _neighbour_row(view: RouterView, found: FoundRouter) -> records.NeighbourRow:
    name, net_id, address, version = found.neighbour
    route = view.router.table.find(net_id)
    is_own = route is not None and route[1] > 0  # a default route leads anywhere
    return records.NeighbourRow(
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


def _removed(spec: RouteSpec) -> records.RouteRow:
    kind, port, address = spec.hop.kind, spec.hop.port, spec.hop.address
    return records.RouteRow(
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


class RoutingMethods:
    """Answers for the routers of all stations here, by the names of the stations."""

    def __init__(self, stations: Mapping[str, StationRouting]) -> None:
        self._stations = stations

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                device_records.ROUTING_EXPORT.served_by(self._export),
                device_records.ROUTING_PLAN.served_by(self._plan),
                device_records.ROUTING_APPLY.served_by(self._apply),
                device_records.ROUTING_ROLLBACK.served_by(self._roll_back),
            )
        )

    def _export(self, wanted: device_records.StationParameters) -> device_records.RunningRouting:
        station = self._station(wanted.station)
        last = station.applied
        if last is None:
            return device_records.RunningRouting(routing=station.routes.spec)
        return device_records.RunningRouting(
            routing=last.spec, previous=last.previous, cause=last.cause, undone=last.undone
        )

    def _plan(self, wanted: device_records.RoutingPlanParameters) -> RoutingDifference:
        plan = self._station(wanted.station).plan(wanted.routing)
        return RoutingDifference(changes=plan.changes, refused=plan.refused)

    async def _apply(self, wanted: device_records.RoutingApplyParameters) -> RoutingDifference:
        station = self._station(wanted.station)
        plan = station.plan(wanted.routing)
        if plan.refused:
            return RoutingDifference(changes=[], refused=plan.refused)
        with unless_unavailable():
            changes = await station.apply(wanted.routing, wanted.cause)
        return RoutingDifference(changes=changes, refused=[])

    async def _roll_back(self, wanted: device_records.StationParameters) -> RoutingDifference:
        station = self._station(wanted.station)
        with unless_unavailable():
            return RoutingDifference(changes=await station.roll_back(), refused=[])

    def _station(self, name: str) -> StationRouting:
        return of_station(name, self._stations)
