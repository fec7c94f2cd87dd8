"""The services process: its entry point, its objects, and the EAP devices of its stations.

The supervisor starts it with the descriptor of its handover.  A failure here does not stop the
engine: the two share images, and pairs of sockets on which the engine never waits.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from time import monotonic_ns, time
from typing import TYPE_CHECKING, Any

from eap.ams.directory import Directory
from eap.ams.spec import DirectoryPort, DirectoryStation, RoutingSpec
from eap.control.by_ads import METHODS
from eap.control.protocol import WriteOrigin
from eap.device.eap_dictionary import DeviceIdentity
from eap.errors import ConfigError, EapError, EnvironmentalError, ImageError
from eap.net import realtime
from eap.net.busypoll import BusyPollLoop
from eap.net.image_file import StationImage
from eap.pd.device import DeviceState
from eap.pd.handover import PortChanges
from eap.pd.spec import PortKind, StationSpec
from eap.pd.words import StationWord
from eap.release import RELEASE
from eap.runtime.bridges import bridge_findings, read_bridges
from eap.runtime.drop_counters import DropCounters
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import (
    Handover,
    PortName,
)
from eap.runtime.log import LevelFile, start_logging
from eap.runtime.recordings import recording_findings
from eap.runtime.startup import LIFE_PERIOD_S, Startup, Step, no_step
from eap.runtime.store import StationStore, plant_folder
from eap.services.ads.station_ads import StationAds
from eap.services.bus_table import BusFollower, BusTable
from eap.services.control.audit import Audit, AuditFile
from eap.services.control.bus_methods import Buses, GatewayMethods, bus_reports
from eap.services.control.control_ads import ControlAds, RemoteControl
from eap.services.control.control_server import ControlServer, PeerRoles
from eap.services.control.device_methods import DeviceMethods
from eap.services.control.field_methods import FieldMethods
from eap.services.control.log_methods import LogMethods
from eap.services.control.login_log import LoginLog
from eap.services.control.methods import Methods
from eap.services.control.route_methods import AmsMethods, RouteMethods, RoutingMethods
from eap.services.control.status import (
    ProcessMeter,
    SharedAnswer,
    appliance_status,
    take_snapshot,
)
from eap.services.device.field_player import FieldPlayer, controller_findings
from eap.services.device.image_values import ImageValues
from eap.services.device.monitoring import ProbeSockets, SubscriberWatch
from eap.services.device.sources import SourcePlayer
from eap.services.device.station_device import StationDevice
from eap.services.device.station_keeper import EngineClient, StationEngine, StationKeeper
from eap.services.engine_link import EngineLink
from eap.services.host_watch import HostWatch
from eap.services.limited_log import LimitedLogHandler
from eap.services.network import Network
from eap.services.routing.route_rows import (
    RouterView,
    interruption_findings,
    route_findings,
)
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import (
    StationRoutes,
    access_of,
    denial_of_control,
    denial_of_write,
    make_router,
)
from eap.services.routing.station_routing import StationRouting
from eap.services.socket_table import SocketFollower, SocketTable
from eap.services.sockets import Transports
from eap.services.supervisor_link import SupervisorLink
from eap.services.tasks import keep_serving
from eap.services.transports.accepting import Listeners
from eap.services.transports.route_logins import RouteLogins
from eap.services.transports.station_brokers import StationBrokers

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway


_LATELY_NS = 2_000_000_000


class StationDevices:
    """EAP devices of all stations, with their routers and ADS services.

    Args:
        plant: Name of the plant.
        stations: Stations that the engine runs.
        states: Initial states; Op for a station without one.
        images: The process image of each station.
        engine: Runs the stations.
        release: Of this software.
        routing: Routing configuration by station; empty for a station without one.
        step: Called with the next step of the start-up.

    Attributes:
        by_station: The devices.
        routers: AMS routers, by station.
        routing: Routing configuration in force, by station.
        brokers: Connections to MQTT brokers, by station; not open yet.
        keepers: Configurations that the stations run, by station.
        specs: What the stations run, by station.
        ads: ADS services at the NetIDs of routers and EAP ports, by station.
    """

    def __init__(
        self,
        plant: str,
        stations: Sequence[StationSpec],
        states: Mapping[str, DeviceState],
        images: Mapping[str, StationImage],
        engine: StationEngine,
        release: str,
        routing: Mapping[str, RoutingSpec] = {},
        *,
        step: Step = no_step,
    ) -> None:
        self.by_station: dict[str, StationDevice] = {}
        self.routers: dict[str, StationRouter] = {}
        self.routing: dict[str, StationRouting] = {}
        self.brokers: dict[str, StationBrokers] = {}
        self.keepers: dict[str, StationKeeper] = {}
        self.specs: dict[str, StationSpec] = {}
        self.ads: dict[str, StationAds] = {}
        self._players: list[SourcePlayer] = []
        self.fields: dict[str, FieldPlayer] = {}
        self._release = release
        self._images = images
        self._has_restarted = asyncio.Event()
        for station in stations:
            step(f"building station {station.name}")
            state = states.get(station.name, DeviceState.OP)
            store = StationStore(plant, station.name)
            keeper = StationKeeper(station, state, store.configuration, engine)
            self._add(station, keeper, store, routing.get(station.name, RoutingSpec()))

    async def serve(self) -> None:
        """Serve all of them until cancelled.

        Raises:
            ExceptionGroup: a source cannot be played, as ``play_sources`` says.
        """
        async with asyncio.TaskGroup() as group:
            for router in self.routers.values():
                group.create_task(router.serve())
            for ads in self.ads.values():
                group.create_task(ads.serve())
            for player in self._players:
                group.create_task(player.serve())
            for field in self.fields.values():
                group.create_task(field.serve())
            group.create_task(self._follow_restarts())

    def engine_has_restarted(self) -> None:
        """Synchronize the new engine with the devices, soon."""
        self._has_restarted.set()

    def _add(
        self,
        station: StationSpec,
        keeper: StationKeeper,
        store: StationStore,
        routing: RoutingSpec,
    ) -> None:
        name, image = station.name, self._images[station.name]
        if _runs(image):
            self._has_restarted.set()  # the previous services process may have ended in a change
        player = SourcePlayer(station, image)
        keeper.on_change.append(player.change)
        self.fields[name] = field = FieldPlayer(station, image)
        keeper.on_change.append(field.change)
        self.keepers[name] = keeper
        self.specs[name] = station
        keeper.on_change.append(partial(self.specs.__setitem__, name))
        self._players.append(player)
        identity = DeviceIdentity(
            device_name=f"EAP station {name}",
            hardware_version=os.uname().machine,
            software_version=self._release,
        )
        device = StationDevice(keeper, ImageValues(image), identity, store.draft)
        self.by_station[name] = device
        self.routers[name] = router = make_router(station, routing)
        self.brokers[name] = StationBrokers(router)
        self.routing[name] = StationRouting(
            name,
            StationRoutes(router, routing, store.routes),
            store.routing,
            lambda spec: router.set_access(access_of(self.specs[name], spec)),
            self.brokers[name],
        )
        self.routing[name].start()
        self.ads[name] = StationAds(station, device, image, router, identity)
        keeper.on_change.append(partial(self._follow, name))

    def _follow(self, name: str, spec: StationSpec) -> None:
        """Follow another specification of a station: its NetIDs, addresses and dictionaries."""
        self.ads[name].follow(spec)
        self.routers[name].set_access(access_of(spec, self.routing[name].routes.spec))

    async def _follow_restarts(self) -> None:
        while True:
            await self._has_restarted.wait()
            self._has_restarted.clear()
            for image in self._images.values():
                with suppress(ImageError):  # its readers get the error
                    image.reopen_if_replaced()  # an engine that died may have retired no buffer
            for device in self.by_station.values():
                await device.resend()


def _runs(image: StationImage) -> bool:
    """Return whether an engine has run a cycle of the station just now."""
    ran_at_ns = image.image.words[StationWord.CYCLE_AT_NS]
    return bool(ran_at_ns) and monotonic_ns() - ran_at_ns < _LATELY_NS


STATUS_TIMEOUT_S = 0.3
"""Time limit of ``status`` for the engine's report of its buses."""
_IMAGE_PAUSE_S = 0.01

logger = logging.getLogger(__name__)


class Services:
    """Objects of one services process, from its start to its end."""

    def __init__(
        self,
        handover: Handover,
        startup: Startup,
        log: LimitedLogHandler,
        resources: ExitStack,
    ) -> None:
        self._handover = handover
        self._startup = startup
        self._log = log
        self._resources = resources
        self._folder = ApplianceFolder(Path(handover.folder))
        self._directory = Directory(handover.directory)
        self._names = [station.name for station in handover.stations]
        self._counters = resources.enter_context(
            DropCounters(self._folder.discards("services"), self._names)
        )
        self._link = resources.enter_context(socket.socket(fileno=handover.link_fd))
        self._listener = resources.enter_context(socket.socket(fileno=handover.control_fd))
        self._listeners = Listeners()
        self._stopping = asyncio.Event()
        self._passing: list[Callable[[StationSpec], None]] = []
        """Pass the engine descriptors that a specification needs."""

    async def run(self) -> None:
        """Serve until SIGTERM."""
        images = {name: await self._open_image(name) for name in self._names}
        # Not earlier: while it waits for images of a failed engine, SIGTERM must end the process.
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, self._stopping.set)
        link = EngineLink(socket.socket(fileno=self._handover.bus_fd))
        self._resources.callback(link.close)
        supervisor = SupervisorLink(socket.socket(fileno=self._handover.supervisor_fd))
        self._resources.callback(supervisor.close)
        sockets = SocketTable(self._handover, supervisor, self._link)
        self._resources.callback(sockets.close)
        devices = self._devices(images, link, sockets)
        self._startup.step("opening gateways and sockets")
        audit = self._audit(devices.routers)
        buses = self._bus_table(link, supervisor, devices, audit)
        logins = LoginLog(self._handover.plant, audit)
        route_logins = RouteLogins(self._handover.users)
        network = Network(
            sockets,
            devices.routers,
            {name: each.routes for name, each in devices.routing.items()},
            buses.gateways,
            self._counters,
            self._listeners,
            self._link,
            route_logins,
        )
        transports = Transports(network)
        sockets.on_change.append(transports.follow)
        brokers = self._brokers(devices)
        hosts = HostWatch(
            self._handover.host,
            self._handover.hosts,
            {each.name: each.net_id for each in self._handover.directory},
            devices.routers,
        )
        methods = self._methods(images, buses, devices, audit, sockets, hosts, logins)
        remote = RemoteControl(methods.call, devices.routers, record=audit.write_request)
        for name, router in devices.routers.items():
            router.add_service(router.net_id, ControlAds(name, remote))
        reachable = Buses(devices.specs, buses.clients, buses.segments)
        server = ControlServer(
            methods,
            reachable,
            audit.write_request,
            announce=audit.begin_request,
            roles=PeerRoles(self._handover.users, self._handover.operators),
        )
        watch = self._subscriber_watch(images, sockets)
        on_sockets: list[Callable[[], Awaitable[None]]] = [
            partial(server.serve, self._listener, self._listeners),
            self._listeners.serve,
            *(each.serve for each in brokers),
            watch.run,
            partial(route_logins.logins.report, logins.note_routes),
        ]
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(keep_serving(serve)) for serve in on_sockets]
            tasks.append(group.create_task(transports.serve()))
            tasks += [group.create_task(each.serve()) for each in (devices, audit, self._log)]
            tasks.append(group.create_task(hosts.serve()))
            self._startup.finish({}, is_watched=True)
            tasks.append(group.create_task(self._beat()))
            await self._stopping.wait()
            # Cancel rather than raise: the TaskGroup then waits until all connections are closed.
            for task in tasks:
                task.cancel()
        await buses.close()
        transports.close()

    async def _beat(self) -> None:
        while True:
            self._startup.beat()
            await asyncio.sleep(LIFE_PERIOD_S)

    async def _open_image(self, station: str) -> StationImage:
        """Open one image; at the first start the engine creates it meanwhile.

        The supervisor limits the time, by the progress of both processes.
        """
        while True:
            try:
                image = StationImage(self._folder.image(station))
            except ImageError as exc:
                is_made = self._folder.image(station).exists()
                why = str(exc) if is_made else f"no image of station {station} yet"
                self._startup.step(f"waiting for the engine: {why}", waits_for="engine")
            else:
                self._resources.callback(image.close)
                return image
            await asyncio.sleep(_IMAGE_PAUSE_S)

    def _subscriber_watch(
        self, images: Mapping[str, StationImage], sockets: SocketTable
    ) -> SubscriberWatch:
        probes = ProbeSockets(self._resources)
        probes.follow(sockets.sockets, sockets.port)
        watch = SubscriberWatch(images, probes.probes)

        async def follow(spec: StationSpec, changes: PortChanges) -> None:
            del spec, changes
            probes.follow(sockets.sockets, sockets.port)
            watch.follow()

        sockets.on_change.append(follow)
        return watch

    def _devices(
        self, images: dict[str, StationImage], link: EngineLink, sockets: SocketTable
    ) -> StationDevices:
        handover = self._handover
        self._passing.append(sockets.pass_to_engine)
        engine = EngineClient(link, Path(handover.folder), self._pass_to_engine)
        devices = StationDevices(
            handover.plant,
            handover.stations,
            handover.states,
            images,
            engine,
            RELEASE,
            handover.routing,
            step=self._startup.step,
        )
        link.on_restart.append(devices.engine_has_restarted)
        for name, keeper in devices.keepers.items():
            keeper.followers.append(SocketFollower(sockets, name))
            keeper.on_change.append(lambda spec: self._directory.replace(directory_station(spec)))
        gc.freeze()  # each collection would scan these objects, while clients wait
        return devices

    def _pass_to_engine(self, spec: StationSpec) -> None:
        for pass_on in self._passing:
            pass_on(spec)

    def _brokers(self, devices: StationDevices) -> list[StationBrokers]:
        """Open those that are configured now, which the plant file may not have."""
        for name, brokers in devices.brokers.items():
            brokers.open(devices.routing[name].routes.spec, partial(self._counters.count, name))
        return [*devices.brokers.values()]

    def _methods(
        self,
        images: dict[str, StationImage],
        buses: BusTable,
        devices: StationDevices,
        audit: Audit,
        sockets: SocketTable,
        hosts: HostWatch,
        logins: LoginLog,
    ) -> Methods:
        meter = ProcessMeter()
        engine = self._resources.enter_context(
            DropCounters(self._folder.discards("engine"), self._names)
        )
        handover = self._handover
        identity = {
            "release": RELEASE,
            "plant": handover.plant,
            "pid": os.getpid(),
            "host": handover.host,
            "plant_file": handover.plant_file,
            "audit_required": handover.audit_required,
            "by_ads": list(METHODS),
        }

        async def status() -> dict[str, Any]:
            reports = await bus_reports(buses.clients, STATUS_TIMEOUT_S)
            info = self._folder.read_info()
            bridges = read_bridges(self._folder.path, info)
            document = appliance_status(
                info,
                [await take_snapshot(each.image) for each in images.values()],
                (engine.stats(), self._counters.stats()),
                meter,
                reports,
                self._listeners.stats(),
                bridges,
            )
            return document | {
                "audit": audit.report(),
                "logins": logins.report(),
                "release": RELEASE,
                **({"host": hosts.own, "hosts": hosts.report()} if hosts.own else {}),
                "findings": [
                    *hosts.findings(),
                    *logins.findings(),
                    *route_findings(devices.routers.values()),
                    *interruption_findings(devices.routers.values(), time()),
                    *(row for each in devices.by_station.values() for row in each.findings()),
                    *recording_findings(self._handover.plant, time()),
                    *bridge_findings(self._handover.plant, bridges),
                    *controller_findings(document["stations"]),
                ],
            }

        return Methods(
            identity,
            images,
            status=SharedAnswer(status).get,
            stop=lambda: os.kill(self._handover.supervisor, signal.SIGTERM),
            deny_write=lambda station, origin: denial_of_write(devices.routers[station], origin),
            more=self._more_methods(devices, sockets)
            | GatewayMethods(sockets, buses.gateways).table()
            | logins.table(),
        )

    def _more_methods(
        self, devices: StationDevices, sockets: SocketTable
    ) -> dict[str, Callable[[dict[str, Any]], Any]]:
        views = {
            name: RouterView(router, devices.routing[name].routes)
            for name, router in devices.routers.items()
        }
        routers = {name: ads.dictionary for name, ads in devices.ads.items()}
        plant_file = self._handover.plant_file

        def deny_control(station: str, origin: WriteOrigin) -> str:
            return denial_of_control(devices.routers[station], origin)

        return {
            **DeviceMethods(devices.by_station, routers, plant_file, deny_control).table(),
            **RouteMethods(views, self._directory).table(),
            **RoutingMethods(devices.routing).table(),
            **FieldMethods(devices.fields).table(),
            **AmsMethods(
                devices.routers, self._directory, sockets.ams_address, deny_control
            ).table(),
            **LogMethods(LevelFile(self._folder.path), self._followers).table(),
        }

    def _followers(self) -> list[str]:
        """Return the optional processes that look at the file of log levels."""
        try:
            extras = self._folder.read_info().extras
        except OSError:
            return []
        return [name for name in extras if not name.startswith("recording ")]

    def _audit(self, routers: Mapping[str, StationRouter]) -> Audit:
        file = AuditFile(plant_folder(self._handover.plant) / "audit.jsonl")
        is_required = self._handover.audit_required
        audit = Audit(file, self._directory, is_required=is_required)
        for name, router in routers.items():
            router.on_audit.append(partial(audit.write, name))
            if is_required:
                router.require_record(partial(audit.begin, name))
        return audit

    def _bus_table(
        self,
        link: EngineLink,
        supervisor: SupervisorLink,
        devices: StationDevices,
        audit: Audit,
    ) -> BusTable:
        def audit_gateway(owner: PortName, gateway: MailboxGateway) -> None:
            gateway.admission.on_audit.append(partial(audit.write, owner.station))
            if self._handover.audit_required:
                gateway.admission.before_change = partial(audit.begin, owner.station)

        table = BusTable(link, self._link, supervisor, devices.routers, audit_gateway)
        table.start(self._handover.stations, self._handover.buses)
        self._passing.append(table.pass_to_engine)
        for name, keeper in devices.keepers.items():
            keeper.followers.append(BusFollower(table, name, devices.specs))
        return table


def directory_station(spec: StationSpec) -> DirectoryStation:
    """Return the names of a station, of its ports and of their slaves."""
    return DirectoryStation(
        spec.name,
        spec.net_id,
        tuple(
            DirectoryPort(
                port.name,
                port.kind is PortKind.BUS,
                port.net_id,
                port.interface,
                {slave.name: slave.station for slave in port.bus.slaves} if port.bus else {},
            )
            for port in spec.ports
        ),
    )


def main(handover_fd: int, startup: Startup) -> int:
    """Run services; return the exit code, 2 for an error of the specification or of this host."""
    handover = Handover.from_descriptor(handover_fd)
    # A services process without supervisor would keep the ports of the next start.
    realtime.die_with_parent(handover.supervisor)
    if handover.options.realtime:
        realtime.raise_process_priority()
    log = LimitedLogHandler()
    start_logging("services", log)
    try:
        with ExitStack() as resources, asyncio.Runner(loop_factory=BusyPollLoop) as runner:
            runner.run(Services(handover, startup, log, resources).run())
    except EapError as exc:
        sys.stderr.write(f"services: {exc}\n")
        return 2 if isinstance(exc, (ConfigError, EnvironmentalError)) else 1
    return 0
