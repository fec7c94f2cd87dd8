"""ADS services of a station: system service, router and EAP ports.

The system service is at the NetID of the router and at those of the EAP ports: a TwinCAT system has
one NetID for all, and clients use the one that they were given.

An EAP port serves its dictionary, its state and the variables of its station.  Requests that change
a dictionary or a state go through the job queue of the device, since the engine has to agree; all
others are answered at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from secrets import randbelow
from time import monotonic_ns
from typing import Any, Protocol

from eap.ads.io import IoDevice, IoDeviceType, IoSpace, NoSegmentSpace
from eap.ads.notifications import AdsClient
from eap.ads.objects import ObjectSpace
from eap.ads.request import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.ads.space import SystemSpace
from eap.ams.record import Outcome, Stats
from eap.ams.report import ConnectionReport, RouteReport, RouteState
from eap.ams.routes import Route, RouteTable
from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    AdsState,
    AdsSystemState,
    IndexGroup,
    encode_result,
)
from eap.codec.ams import DEVICE_PORT, IO_PORT, SYSTEM_PORT, AmsAnswer, AmsCommand, AmsHeader
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.errors import ControlError, ImageError
from eap.gateway.error_table import ads_result
from eap.ids import MacAddr, NetId
from eap.net.image_file import StationImage
from eap.od.abort import SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.router9000 import RouterLive
from eap.pd.handover import PORT_CONTENT, port_changes
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.services.ads.ads_service import AdsService, device_info
from eap.services.ads.station_symbols import NotificationPump, StationSymbols
from eap.services.device.station_device import StationDevice
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import RouteQuery

_RESTART_INDEX = randbelow(0xFFFF) + 1
"""Another one at each start of this process, by which others know that subscriptions are gone."""


class SystemAds(AdsService):
    """The system service behind one NetID.

    Args:
        device: The EAP device of the station, whose state is that of the whole.
        info: What ReadDeviceInfo tells.
    """

    def __init__(self, device: StationDevice, info: AdsDeviceInfo) -> None:
        super().__init__(device, info, {SYSTEM_PORT: [SystemSpace(self._system_state)]})
        self._info = info

    def perform(
        self, port: int, client: AdsClient, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation; another state is waited for."""
        if isinstance(operation, WriteControl) and operation.ads_state == AdsState.RESET:
            # TwinCAT's system service goes to RUN by it; ads-client knows no other way.
            operation = operation._replace(ads_state=AdsState.RUN)
        return super().perform(port, client, operation)

    def _system_state(self) -> AdsSystemState:
        states, info = self.states(), self._info
        return AdsSystemState(
            states.ads_state,
            states.device_state,
            restart_index=_RESTART_INDEX,
            version=info.major,
            revision=info.minor,
            build=info.build,
        )


_INTERFACES = Path("/sys/class/net")
_BUS_STATE = "state"
"""Variable of a bus port."""


class ReportingRouter(Protocol):
    """Interface to the router of a station."""

    @property
    def table(self) -> RouteTable:
        """Its routes."""

    def report(self, route: Route) -> RouteReport:
        """Return the report of a route."""

    def connections(self) -> list[ConnectionReport]:
        """Return the reports of all connections."""

    def stats(self) -> Stats:
        """Return the counters of the router."""


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
        self.follow(ports)
        self._routes: tuple[Route, ...] = ()
        self._version = -1

    def follow(self, ports: Sequence[PortSpec]) -> None:
        """Have other ports from now on."""
        self._ports: Mapping[str, PortSpec] = {port.name: port for port in ports}

    def number(self, key: RouterLive) -> int:
        """Return the value of *key* for the router as a whole."""
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
        uri = self._ports[port].interface
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
        """Return the value of *key* for one of the routes."""
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


_TYPES = {PortKind.EAP: IoDeviceType.EAP, PortKind.BUS: IoDeviceType.MASTER}


class RouterAds(AdsService):
    """ADS services at the NetID of a station: I/O server and dictionary of the router.

    Args:
        station: Whose router it is.
        device: The EAP device of the station, whose state is that of the whole.
        dictionary: Of the router.
        info: What ReadDeviceInfo tells.
    """

    def __init__(
        self,
        station: StationSpec,
        device: StationDevice,
        dictionary: RouterDictionary,
        info: AdsDeviceInfo,
    ) -> None:
        self._io = IoSpace(_io_devices(station))
        objects = ObjectSpace(dictionary, lambda: OdState.OP, ads_result)
        super().__init__(device, info, {IO_PORT: [self._io], DEVICE_PORT: [objects]})

    def follow(self, station: StationSpec) -> None:
        """List the present ports of *station*."""
        self._io.follow(_io_devices(station))

    def perform(
        self, port: int, client: AdsClient, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation at an AMS port; the I/O server has no state to go to."""
        if port == IO_PORT:
            return self.devices[port].perform(operation, client, monotonic_ns())
        return super().perform(port, client, operation)


def _io_devices(station: StationSpec) -> Iterator[IoDevice]:
    for number, port in enumerate(station.ports, start=1):
        yield IoDevice(number, port.name, _TYPES[port.kind], port.net_id)


_READ, _DONE = AmsCommand.READ.value, AdsError.NONE.value  # members of enums are slow
_BUSY_PAUSE_S = 0.005
_BUSY_PAUSES = 20
"""Before a client is told that a writer has stopped in the middle of writing."""


class EapAds(AdsService):
    """ADS services at the NetID of one EAP port.

    Args:
        device: Of the station.
        port: Name of the port.
        symbols: The station's variables.
        info: What ReadDeviceInfo tells.
    """

    def __init__(
        self, device: StationDevice, port: str, symbols: StationSymbols, info: AdsDeviceInfo
    ) -> None:
        objects = ObjectSpace(device.dictionaries[port], device.od_state, ads_result)
        super().__init__(device, info, {DEVICE_PORT: [objects, symbols, NoSegmentSpace()]})
        self._port = port
        self._ads = self.devices[DEVICE_PORT]

    def answer_now(self, header: AmsHeader, body: bytes) -> AmsAnswer | None:
        """Answer a Read that nothing speaks against; None for all else, which :meth:`answer` does.

        Most requests are such.
        """
        # The common request, a plain read, is answered without an operation or a task.
        if header.command != _READ or len(body) != AdsRange.SIZE:
            return None
        requested = AdsRange.decode(body)
        try:
            data = self._ads.read(requested.group, requested.offset, requested.length)
        except AdsRefusedError:
            return None
        return AmsAnswer(encode_result(_DONE, data))

    def perform(
        self, port: int, client: AdsClient, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Execute one operation; changes, and retries while BUSY, are awaited."""
        if isinstance(operation, WriteControl):
            return super().perform(port, client, operation)
        perform = partial(self._ads.perform, operation, client, monotonic_ns())
        if _changes_objects(operation):
            return self._change(perform)
        outcome = perform()
        # A write that found another writer is not repeated: its client decides which value counts.
        if outcome.result == AdsError.BUSY and not isinstance(operation, Write):
            return _retry_busy(perform)
        return outcome

    async def _change(self, perform: Callable[[], OperationOutcome]) -> OperationOutcome:
        try:
            return await self.device.change(self._port, perform)
        except SdoAbortError as exc:
            return OperationOutcome(ads_result(exc), why=str(exc))
        except ControlError as exc:
            return OperationOutcome(AdsError.BUSY, why=str(exc))


async def _retry_busy(perform: Callable[[], OperationOutcome]) -> OperationOutcome:
    """Repeat an operation while a writer holds the image; after the last try it is BUSY."""
    for _ in range(_BUSY_PAUSES):
        await asyncio.sleep(_BUSY_PAUSE_S)
        outcome = perform()
        if outcome.result != AdsError.BUSY:
            break
    return outcome


def _changes_objects(operation: Operation) -> bool:
    if isinstance(operation, ReadWrite):
        return operation.group == IndexGroup.SDO and bool(operation.data)
    return isinstance(operation, Write) and operation.group == IndexGroup.SDO


class StationAds:
    """The services behind the NetIDs of one station's router and EAP ports.

    Args:
        station: As it was handed over.
        device: Its EAP device.
        image: Its process image.
        router: Where requests come from, and which sends notifications.
        identity: Of the station's devices.

    Attributes:
        dictionary: Of the router.
        pump: Tells whom notifications are for; devices of buses may be added.
    """

    def __init__(
        self,
        station: StationSpec,
        device: StationDevice,
        image: StationImage,
        router: StationRouter,
        identity: DeviceIdentity,
    ) -> None:
        self._station = station
        self._device = device
        self._router = router
        self._release = identity.software_version
        self._symbols = StationSymbols(image)
        self.pump = NotificationPump(self._symbols, router.send_notification)
        self._values = LiveRouter(router, device, image, station.ports)
        self.dictionary = RouterDictionary(station, self._values, identity)
        info = device_info(station.name, self._release)
        self._own = RouterAds(station, device, self.dictionary, info)
        router.add_service(router.net_id, self._own)
        self._drive(self._own, router.net_id)
        self._system = SystemAds(device, info)
        router.add_service(router.net_id, RouteQuery(router, self._system))
        self._drive(self._system, router.net_id)
        for port in station.ports:
            if port.kind is PortKind.EAP:
                self._add(port)

    def follow(self, station: StationSpec) -> None:
        """Serve the present ports of *station*; the device has their dictionaries."""
        before, self._station = self._station, station
        if before.ports == station.ports:
            return
        changes = port_changes(before, station, PORT_CONTENT)
        for port in changes.gone:
            self.pump.remove(port.net_id)
            self._router.remove_net_id(port.net_id)
        self._values.follow(station.ports)
        self.dictionary.follow(station)
        self._own.follow(station)
        for port in changes.added:
            self._router.add_net_id(port.net_id)
            self._add(port)

    def _add(self, port: PortSpec) -> None:
        name = f"{self._station.name}/{port.name}"
        info = device_info(name, self._release)
        of_port = EapAds(self._device, port.name, self._symbols, info)
        system = SystemAds(self._device, device_info(self._station.name, self._release))
        for service in (of_port, system):
            self._router.add_service(port.net_id, service)
            self._drive(service, port.net_id)

    async def serve(self) -> None:
        """Send notifications until cancelled."""
        await self.pump.serve()

    def _drive(self, service: AdsService, net_id: NetId) -> None:
        for ams_port, table in service.notifications.items():
            self.pump.add(table, net_id, ams_port)
