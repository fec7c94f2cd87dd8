"""The supervisor: starts the processes of one appliance, starts again what dies, ends them all.

It does no protocol work.  What must outlive a process of the appliance is held here: the shared
sockets, the control listener, the pair between engine and services, and the lock of the folder.
"""

from __future__ import annotations

import logging
import os
import select
import signal
from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic_ns

import msgspec
from msgspec.structs import replace

from eap.ams.spec import RoutingSpec
from eap.config.load import Plant
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.realtime import raise_descriptor_limit, require_cores
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from eap.runtime.folder import ApplianceFolder, ApplianceInfo, ProcessInfo, folder_name
from eap.runtime.handover import (
    NO_DESCRIPTOR,
    BusSocket,
    EngineOptions,
    Handover,
    InheritedRecord,
    SegmentHandover,
)
from eap.runtime.socket_plan import require_own_buses
from eap.runtime.startup import catch_end_signals
from eap.runtime.store import StationStore, adopt_plant_file, effective
from eap.supervisor.child import LIFE_CHECK_NS, SILENCE_S, Child, StartEvent, describe_end
from eap.supervisor.log_output import LOG, LogForm, LogHandler
from eap.supervisor.optional import missing_extra, optional_processes
from eap.supervisor.part import load_part
from eap.supervisor.service_manager import CycleProgress, ServiceManager
from eap.supervisor.sockets import (
    SharedSockets,
    inherited_by_engine,
    inherited_by_services,
)
from eap.supervisor.stored_start import with_stored_configuration

GRACE_NS = 1_000_000_000
"""Time for a process to end after SIGTERM; the whole appliance has two seconds."""
_EXTRA_PAUSE_NS = 500_000_000
"""Shortest pause before an optional process is started again."""
SEGMENT_GRACE_NS = 500_000_000
"""The same for simulated segments, which end after the others."""

logger = logging.getLogger(__name__)


def run(
    plant_file: Path,
    stations: Sequence[str] = (),
    *,
    host: str = "",
    options: EngineOptions = EngineOptions(),  # noqa: B008  frozen
    log: LogForm = LogForm.AUTO,
) -> int:
    """Run the plant in *plant_file*, or only some of its *stations*, until a stop signal.

    Of a plant with several hosts, the stations of *host* run, or of the one that this computer is.

    Returns:
        The exit code: 0 after a stop signal, 1 or 2 when it could not start.

    Raises:
        ConfigError: the file is no plant; one line a finding.
        EnvironmentalError: this machine lacks something that the plant needs.
    """
    plant, own = load_part(plant_file, stations, host)
    LOG.begin(log, plant.name)
    require_own_buses(plant.stations)
    subset = [station.name for station in plant.stations] if stations or own else []
    info = make_info(plant.name, str(plant_file.resolve()), plant.stations)
    info.host = own
    with _claim(folder_name(plant.name, subset)) as folder:
        return _run(info, plant, folder, options)


def run_blank(
    plant: Plant, *, options: EngineOptions, resume: bool = False, log: LogForm = LogForm.AUTO
) -> int:
    """Run *plant*, which no file describes, until a stop signal.

    Its stations start in PreOp, as *plant* has them or, with *resume*, as they were configured
    last, in the state that was requested then.  Returns and raises as ``run`` does.
    """
    LOG.begin(log, plant.name)
    info = make_info(plant.name, "", plant.stations)
    with _claim(folder_name(plant.name)) as folder:
        for station in plant.stations:
            store = StationStore(plant.name, station.name)
            if resume:
                store.bring_back()
            elif store.set_aside():
                logger.warning(
                    "station %s starts blank; --resume restores its last configuration",
                    station.name,
                )
        return _run(info, plant, folder, options, DeviceState.PREOP)


def _claim(folder: str) -> ApplianceFolder:
    logging.basicConfig(level=logging.INFO, handlers=[LogHandler()])
    raise_descriptor_limit()
    return ApplianceFolder.claim(folder)


def _run(
    info: ApplianceInfo,
    plant: Plant,
    folder: ApplianceFolder,
    options: EngineOptions,
    first_state: DeviceState = DeviceState.OP,
) -> int:
    stations = plant.stations
    if plant.spins:
        require_cores()
        options = replace(options, spins=True)
    adopt_plant_file(info.plant, stations, first_state)
    if info.plant_file:
        _log_stored_differences(info.plant, stations)
    has_other_users = any(user.unix or user.groups for user in plant.users)
    if has_other_users:
        folder.share()
    with SharedSockets(folder.control_socket) as sockets:
        if has_other_users:
            folder.control_socket.chmod(0o666)
        supervisor = Supervisor(
            info, plant, folder, sockets, options=options, first_state=first_state
        )
        return supervisor.run()


def _log_stored_differences(plant: str, stations: Sequence[StationSpec]) -> None:
    """Say which stations start otherwise than their plant file alone would have them."""
    for spec, kept in zip(stations, effective(plant, stations), strict=True):
        if kept.spec != spec:
            logger.warning(
                "station %s runs as it was configured last; 'eapctl plan' shows what differs from"
                " the plant file",
                spec.name,
            )
        if kept.state is not DeviceState.OP:
            logger.warning(
                "station %s starts in %s, requested last; 'eapctl state %s OP' changes it",
                spec.name,
                kept.state.name,
                spec.name,
            )


class Supervisor:
    """Runs engine, services and simulated buses of the stations of *plant* until a stop signal.

    Other stations are in its directory only.
    """

    def __init__(
        self,
        info: ApplianceInfo,
        plant: Plant,
        folder: ApplianceFolder,
        sockets: SharedSockets,
        *,
        options: EngineOptions,
        first_state: DeviceState = DeviceState.OP,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._clock = clock
        self._info = info
        info.audit_required = plant.audit_required
        info.sections = plant.section_digests()
        self._folder = folder
        self._bytecode = str(folder.bytecode)
        self._engine = Child("engine", "eap.engine.process", self._bytecode)
        self._services = Child("services", "eap.services.process", self._bytecode)
        self._segments: dict[BusSocket, Child] = {}
        """Of simulated buses, by key."""
        self._extras: dict[Child, InheritedRecord] = {}
        """Optional processes; the plant runs without them."""
        self._leaving: dict[Child, int] = {}
        """Segments of buses that were closed, and when they are killed."""
        self._restart_ns: dict[Child, int] = {}
        self._manager = ServiceManager(os.environ)
        station = plant.stations[0]
        self._progress = CycleProgress(folder.image(station.name), station.cycle_us)
        self._life_ns = 0
        self._announced = False
        self._is_info_old = False
        self._exit_code: int | None = None
        common = Handover(
            supervisor=os.getpid(),
            folder=str(folder.path),
            plant=info.plant,
            plant_file=info.plant_file,
            stations=plant.stations,
            sockets=(),
            options=options,
            first_state=first_state,
            routing=_own_routing(plant),
            directory=plant.directory,
            audit_required=plant.audit_required,
            host=info.host,
            hosts=plant.hosts,
            users=plant.users,
            operators=plant.operators,
        )
        self._extras |= optional_processes(plant, folder, self._bytecode)
        self._sockets = sockets
        self._common = common
        self._given = {
            self._engine: replace(common, link_fd=sockets.engine_link, bus_fd=sockets.engine_bus),
            self._services: replace(
                common,
                link_fd=sockets.services_link,
                bus_fd=sockets.services_bus,
                control_fd=sockets.control,
                supervisor_fd=sockets.services_end,
            ),
        }

    @property
    def _children(self) -> tuple[Child, ...]:
        return (*self._needed, *self._extras, *self._leaving)

    @property
    def _needed(self) -> tuple[Child, ...]:
        return (*self._segments.values(), self._engine, self._services)

    def run(self) -> int:
        """Return the exit code when everything has ended."""
        with catch_end_signals() as wake_fd:
            try:
                for child in (self._engine, self._services):
                    self._start(child)
                while self._exit_code is None:
                    self._wait(wake_fd, self._timeout_ms())
                    self._check_time()
            finally:
                self._end_children()
        return self._exit_code

    def _start(self, child: Child) -> None:
        # At each start and not once: the station may have been reconfigured since.
        handover = with_stored_configuration(self._given[child], self._sockets)
        if child is self._services:
            # The process before may have ended in a change, which no one goes on with.  The engine
            # may still have the sockets of that change: services closes them once it has not.
            self._sockets.serve()
            left = self._sockets.beyond(handover.sockets)
            self._sockets.keep_only((*handover.sockets, *left, *handover.buses))
            handover = replace(handover, sockets=(*handover.sockets, *left))
            descriptors = inherited_by_services(handover)
        else:
            descriptors = inherited_by_engine(handover)
        self._start_with(child, handover, descriptors)
        self._follow_buses()

    def _start_segment(self, bus: BusSocket, child: Child) -> None:
        handover = SegmentHandover(
            self._common.supervisor,
            InterfaceUri.parse(bus.interface).host,
            bus.simulated,
            str(self._folder.segment(bus.simulated)) if bus.simulated else "",
            frames_fd=bus.segment_fd,
            command_fd=bus.segment_command_fd,
            second_fd=bus.segment_second_fd,
            realtime=self._common.options.realtime,
        )
        given = (handover.frames_fd, handover.command_fd, handover.second_fd)
        self._start_with(child, handover, [fd for fd in given if fd != NO_DESCRIPTOR])

    def _follow_buses(self) -> None:
        """Start the simulated slaves of buses that are new, and end those of closed ones."""
        simulated = {bus.key: bus for bus in self._sockets.buses if bus.is_simulated}
        for key in self._segments.keys() - simulated.keys():
            self._dismiss(self._segments.pop(key))
        for key, bus in simulated.items():
            if key not in self._segments:
                name = f"segment {_label(key)}"
                child = Child(name, "eap.segment.process", self._bytecode)
                self._segments[key] = child
                self._start_segment(bus, child)
            elif self._segments[key].watch.has_run:
                self._sockets.confirm(bus)

    def _dismiss(self, child: Child) -> None:
        """End a segment whose bus was closed."""
        self._restart_ns.pop(child, None)
        if child.pid:
            child.send_signal(signal.SIGTERM)
            self._leaving[child] = self._clock() + SEGMENT_GRACE_NS

    def _refuse_bus(self, child: Child, reason: str) -> bool:
        """Refuse the request for the bus of a segment that cannot start; return False if none."""
        key = next((key for key, each in self._segments.items() if each is child), None)
        if key is None or not self._sockets.refuse(key, reason):
            return False
        del self._segments[key]
        self._restart_ns.pop(child, None)
        return True

    def _start_with(
        self, child: Child, handover: Handover | SegmentHandover, descriptors: list[int]
    ) -> None:
        self._restart_ns.pop(child, None)
        try:
            child.start(handover, descriptors, self._clock())
        except OSError as exc:
            # A start that failed half way leaves its pipes open.
            child.close()
            reason = f"{child.name} cannot be started: {exc}"
            if self._refuse_bus(child, reason):
                return
            if not child.watch.has_run and not self._announced:
                raise EnvironmentalError(reason) from None
            delay_ns = child.policy.delay_ns(0)
            self._restart_ns[child] = self._clock() + delay_ns
            logger.warning(
                "%s cannot be started: %s; trying again in %d ms",
                *(child.name, exc, delay_ns // 1_000_000),
            )
        self._write_info()

    def _timeout_ms(self) -> int:
        now_ns = self._clock()
        deadlines = [self._life_ns, *self._restart_ns.values(), *self._leaving.values()]
        timeouts = (child.watch.next_timeout() for child in self._children)
        deadlines += [each for each in (*timeouts, self._manager.next_ns) if each is not None]
        return max(0, -(-(min(deadlines) - now_ns) // 1_000_000))

    def _wait(self, wake_fd: int, timeout_ms: int) -> None:
        poll = select.poll()
        poll.register(wake_fd, select.POLLIN)
        poll.register(self._sockets, select.POLLIN)
        for child in self._children:
            # Signs of life are read in looks: each of them would wake this process.
            report_fd = -1 if child.is_ready else child.report_fd
            for fd in (child.pid_fd, report_fd, child.error_fd):
                if fd >= 0:
                    poll.register(fd, select.POLLIN)
        fired = {fd for fd, _ in poll.poll(timeout_ms)}
        if wake_fd in fired:
            # All bytes of it: signals that came together count once.
            os.read(wake_fd, 64)
            self._exit_code = 0
            return
        for child in self._children:
            if child.error_fd in fired:
                child.forward_output()
            if child.report_fd in fired:
                self._follow_start(child)
            if child.pid_fd in fired:
                self._handle_exit(child)
        # Last: a descriptor of a process that it starts may be equal to one that has fired.
        if self._sockets.fileno() in fired:
            self._sockets.serve()
            self._follow_buses()

    def _follow_start(self, child: Child) -> None:
        running = {each.name for each in self._children if each.is_ready}
        reports = child.read_reports()
        for each in reports:
            waits_for = "" if each.waits_for in running else each.waits_for
            child.watch.advance(each.step, self._clock(), waits_for=waits_for)
        if child.is_ready:
            self._is_ready(child)
        elif reports:
            self._write_info()

    def _is_ready(self, child: Child) -> None:
        child.watch.succeed()
        child.fault = ""
        for each in self._children:
            each.watch.release(child.name, self._clock())
        self._follow_buses()  # a request may wait for this segment
        self._write_info()
        if child.restarts:
            took_ms = (self._clock() - child.started_ns) // 1_000_000
            logger.warning("%s runs again (process %d, %d ms)", child.name, child.pid, took_ms)
        if not self._announced and all(child.is_ready for child in self._needed):
            # Once: restarts later are no news for a script that waits for the start.
            self._announced = True
            # Later than the plant, whose start they would delay; and not here, where a descriptor
            # of theirs may be equal to one that has fired.
            self._restart_ns |= dict.fromkeys(self._extras, self._clock())
            names = ", ".join(self._info.stations)
            self._manager.notify(READY="1", STATUS=f"plant {self._info.plant}: {names}")
            line = msgspec.json.encode({"ready": True, "stations": self._info.stations})
            try:
                os.write(1, line + b"\n")
            except OSError as exc:  # the plant runs all the same
                logger.warning("the ready line cannot be written to stdout: %s", exc.strerror)

    def _handle_exit(self, child: Child) -> None:
        lived_ns = self._clock() - child.started_ns
        last_step = child.watch.step
        code, last_line = child.reap()
        if self._leaving.pop(child, None) is not None:
            self._write_info()
            return
        if child in self._extras:
            # A reason that the process knows is its last step: a line for each try would fill the
            # log.
            known = last_step if code == 2 and last_step else last_line
            reason = describe_end(code) if code <= 0 else known
            if child.life.has_hung:
                reason = f"it gave no sign of life for {SILENCE_S} s"
            self._restart_extra(child, reason, lived_ns)
            return
        never_ran = not child.watch.has_run and not child.watch.is_stuck
        if never_ran and self._refuse_bus(child, last_line.removeprefix("segment: ")):
            self._write_info()
            return
        # A process that has never run would fail again: the appliance ends with its exit code.
        if never_ran and not self._announced:
            if code < 0:
                # A signal leaves no line of the process itself, unlike an exit code.
                logger.error("%s was %s while starting", child.name, describe_end(code))
            self._exit_code = 2 if code == 2 else 1
            return
        child.restarts += 1
        delay_ns = child.policy.delay_ns(lived_ns)
        reason = f": {last_line}" if code > 0 else ""
        logger.warning(
            "%s ended (%s)%s; starting it again in %d ms",
            child.name,
            describe_end(code),
            reason,
            delay_ns // 1_000_000,
        )
        if delay_ns:
            self._restart_ns[child] = self._clock() + delay_ns
            self._write_info()
        else:
            self._start_again(child)

    def _start_extra(self, child: Child) -> None:
        self._restart_ns.pop(child, None)
        if fault := missing_extra(child.name):
            # Only another installation changes this: without a restart it is not tried again.
            child.fault = fault
            logger.warning("%s does not run: %s", child.name, child.fault)
            self._write_info()
            return
        try:
            child.start(self._extras[child], (), self._clock())
        except OSError as exc:
            child.close()
            self._restart_extra(child, f"it cannot be started: {exc}", 0)
        self._write_info()

    def _restart_extra(self, child: Child, reason: str, lived_ns: int) -> None:
        """Start an optional process again after a pause, however often it fails."""
        child.restarts += 1
        delay_ns = max(child.policy.delay_ns(lived_ns), _EXTRA_PAUSE_NS)
        self._restart_ns[child] = self._clock() + delay_ns
        reason = reason.removeprefix(f"{child.name}: ")
        if reason != child.fault:  # the same one, again and again, would fill the log
            pause_ms = delay_ns // 1_000_000
            logger.warning("%s ended: %s; starting it again in %d ms", child.name, reason, pause_ms)
        child.fault = reason
        self._write_info()

    def _start_again(self, child: Child) -> None:
        if child in self._extras:
            self._start_extra(child)
            return
        for bus in self._sockets.buses:
            if self._segments.get(bus.key) is child:
                self._start_segment(bus, child)
                return
        self._start(child)

    def _check_time(self) -> None:
        now_ns = self._clock()
        for child, due_ns in list(self._restart_ns.items()):
            if now_ns >= due_ns and self._exit_code is None:
                self._start_again(child)
        for child, end_ns in self._leaving.items():
            if now_ns >= end_ns:
                child.send_signal(signal.SIGKILL)
                self._leaving[child] = now_ns + GRACE_NS
        for child in self._children:
            self._check_start(child, now_ns)
        if now_ns >= self._life_ns:
            self._life_ns = now_ns + LIFE_CHECK_NS
            for child in self._children:
                self._check_life(child, now_ns)
        if (next_ns := self._manager.next_ns) is not None and now_ns >= next_ns:
            is_alive = all(child.is_alive for child in self._needed)
            self._manager.check(now_ns, is_alive=is_alive and self._progress.is_alive(now_ns))

    def _check_start(self, child: Child, now_ns: int) -> None:
        watch = child.watch
        step, limit_s = watch.step, watch.limit_ns // 1_000_000_000
        event = watch.handle_timeout(now_ns)
        if event is StartEvent.SLOW:
            took_s = watch.took_ns(now_ns) // 1_000_000_000
            logger.warning("%s has been starting for %d s: %s", child.name, took_s, step)
        elif event is StartEvent.STUCK:
            logger.error(
                "%s is stuck: %s, no progress for %d s; it is killed and started again, with %d s"
                " for each step",
                child.name,
                step,
                limit_s,
                watch.limit_ns // 1_000_000_000,
            )
            child.send_signal(signal.SIGKILL)

    def _check_life(self, child: Child, now_ns: int) -> None:
        if not child.is_ready:
            return
        # The engine gives none beside its cycles.
        cycles = self._progress.is_alive(now_ns) if child is self._engine else True
        if child.life.check(is_alive=cycles and child.has_beaten()):
            logger.error(
                "%s hangs: no sign of life for %d s; it is killed and started again",
                *(child.name, SILENCE_S),
            )
            child.send_signal(signal.SIGKILL)

    def _end_children(self) -> None:
        """End all: segments last, for the engine brings their slaves to rest."""
        self._manager.close()
        self._end((*self._extras, self._engine, self._services), GRACE_NS)
        self._end((*self._segments.values(), *self._leaving), SEGMENT_GRACE_NS)

    def _end(self, children: Collection[Child], grace_ns: int) -> None:
        for child in children:
            child.send_signal(signal.SIGTERM)
        deadline_ns = self._clock() + grace_ns
        while running := [child for child in children if child.pid]:
            now_ns = self._clock()
            if now_ns >= deadline_ns:
                for child in running:
                    logger.warning("%s does not end after SIGTERM: killing it", child.name)
                    child.send_signal(signal.SIGKILL)
                # SIGKILL takes effect when the process leaves the kernel: waited for, and sent
                # again if need be.
                deadline_ns = now_ns + GRACE_NS
            poll = select.poll()
            for child in running:
                poll.register(child.pid_fd, select.POLLIN)
            fired = {fd for fd, _ in poll.poll(max(1, (deadline_ns - now_ns) // 1_000_000))}
            for child in running:
                if child.pid_fd in fired:
                    child.reap()

    def _write_info(self) -> None:
        self._info.engine = _process_info(self._engine)
        self._info.services = _process_info(self._services)
        self._info.extras = {child.name: _process_info(child) for child in self._extras}
        self._info.segments = {
            _label(key): _process_info(child) for key, child in self._segments.items()
        }
        try:
            self._folder.write_info(self._info)
        except OSError as exc:  # a full disk: what commands find in it is older than it should be
            if not self._is_info_old:
                logger.warning("%s cannot be written: %s", self._folder.path, exc.strerror)
            self._is_info_old = True
        else:
            self._is_info_old = False


def make_info(plant: str, plant_file: str, stations: Sequence[StationSpec]) -> ApplianceInfo:
    """Return what clients find in the folder of an appliance that this process runs."""
    return ApplianceInfo(
        plant=plant,
        plant_file=plant_file,
        stations=[station.name for station in stations],
        started_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
        supervisor=os.getpid(),
    )


def _process_info(child: Child) -> ProcessInfo:
    return ProcessInfo(child.pid, child.restarts, child.report, child.watch.step, child.fault)


def _own_routing(plant: Plant) -> dict[str, RoutingSpec]:
    names = {station.name for station in plant.stations}
    return {name: routing for name, routing in plant.routing.items() if name in names}


def _label(bus: BusSocket) -> str:
    return f"{bus.owner.station}/{bus.owner.port}"
