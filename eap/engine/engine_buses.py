"""All buses of an engine process: made from the handover, started, and brought to INIT."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Mapping
from functools import partial

from devicebus.master.bus import MasterSettings
from devicebus.master.scan import ExpectedSlave
from eap.engine.bus_requests import BusRequestHandler, ServeStation
from eap.engine.engine_bus import EngineBus
from eap.engine.successor import EngineStation
from eap.net.busport import BusPort
from eap.pd.spec import BusPortSpec, PortSpec
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket, Handover

REST_NS = 300_000_000
"""Limit for bringing slaves to INIT when the engine ends."""
_MIN_BUDGET, _BUDGET_PER_US = 1536, 3
_EPOCH_S = 946_684_800
"""2000-01-01, from which the clocks of slaves count."""


class EngineBuses:
    """The buses of *stations*, in the order of the handover.

    Attributes:
        buses: By their numbers in requests.
        requests: Takes requests of services; None in a test without services.
        arrivals: What to call when a descriptor is readable.
    """

    def __init__(
        self,
        handover: Handover,
        stations: Mapping[str, EngineStation],
        serve_station: ServeStation,
    ) -> None:
        self._handover = handover
        self.buses = [self._make(given, stations[given.owner.station]) for given in handover.buses]
        self.requests: BusRequestHandler | None = None
        self.arrivals: dict[int, Callable[[int], None]] = {
            bus.fileno(): bus.drain for bus in self.buses
        }
        if handover.bus_fd != NO_DESCRIPTOR:
            self.requests = BusRequestHandler(
                socket.socket(fileno=handover.bus_fd), self.buses, serve_station
            )
            self.arrivals[self.requests.fileno()] = self.requests.serve
            for number, bus in enumerate(self.buses):
                bus.faults.on_unsolicited.append(partial(self.requests.forward, number))

    def start(self, now_ns: int) -> None:
        """Begin to bring all buses up."""
        if self.requests is not None:
            self.requests.announce()
        for bus in self.buses:
            bus.start(now_ns)

    def publish(self) -> None:
        """Send services what has changed on the buses."""
        if self.requests is not None:
            self.requests.publish()

    def rest(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Bring all slaves to INIT, or as far as they get in REST_NS."""
        now_ns = clock()
        end_ns = now_ns + REST_NS
        tasks = {bus: bus.shut_down(now_ns) for bus in self.buses}
        while (now_ns := clock()) < end_ns:
            waiting = [bus for bus, task in tasks.items() if not task.is_done]
            if not waiting:
                return
            times = [end_ns, *(at for bus in waiting if (at := bus.next_timeout()) is not None)]
            select.select(waiting, [], [], max(0, min(times) - now_ns) / 1e9)
            for bus in waiting:
                bus.drain(clock())
                bus.handle_timeout(clock())

    def close(self) -> None:
        """Let go of all sockets."""
        for bus in self.buses:
            bus.close()
        if self.requests is not None:
            self.requests.close()

    def _make(self, given: BusSocket, place: EngineStation) -> EngineBus:
        port = self._handover.port(given.owner)
        station = place.station
        epoch_offset_ns = time.time_ns() - time.monotonic_ns() - _EPOCH_S * 1_000_000_000
        bus = EngineBus(
            port,
            master_settings(port, station.spec.cycle_us, epoch_offset_ns),
            station.cycle_ns,
            station.image,
            station.memory_of,
            BusPort(socket.socket(fileno=given.engine_fd)),
        )
        station.connect_bus(bus)
        place.buses[port.name] = bus
        return bus


def master_settings(port: PortSpec, cycle_us: int, epoch_offset_ns: int = 0) -> MasterSettings:
    """Return the settings of the master of *port*, which exchanges data every *cycle_us*.

    *epoch_offset_ns* leads from the engine's clock to the time since 2000.
    """
    spec = port.bus or BusPortSpec()
    expected = [
        ExpectedSlave(
            name=slave.name,
            vendor=slave.vendor,
            product=slave.product,
            revision=slave.revision,
            serial=slave.serial,
            alias=slave.alias,
        )
        for slave in spec.slaves
    ]
    return MasterSettings(
        expected=expected,
        frame_timeout_ns=1000 * spec.frame_timeout_us,
        frame_retries=spec.frame_retries,
        acyclic_octets=max(_MIN_BUDGET, _BUDGET_PER_US * cycle_us),
        clocks=spec.clocks,
        epoch_offset_ns=epoch_offset_ns,
    )
