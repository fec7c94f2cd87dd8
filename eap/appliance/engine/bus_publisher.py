"""Changes of one bus as messages for services: nothing is sent, or built, while nothing changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from devicebus.master.bus import Unit
from eap.appliance.bus_request import BusChange
from eap.appliance.engine.bus_report import describe_slave, expected_slaves, link_presets
from eap.appliance.engine.engine_bus import EngineBus


class BusPublisher:
    """Sends the slaves that have changed since the message that was sent last.

    A message that cannot be sent is not lost: its changes are part of the next one.

    Args:
        number: Of the bus in messages.
        bus: The bus.
        send: Sends a message; returns False if there is no room for it.
    """

    def __init__(self, number: int, bus: EngineBus, send: Callable[[BusChange], bool]) -> None:
        self._number = number
        self._bus = bus
        self._send = send
        self._sent: tuple[object, ...] = ()
        self._units: Mapping[int, Unit] | None = None
        self._presets: Mapping[int, int] = {}
        self._changes = 0

    def reset(self) -> None:
        """Send all slaves next: the receiver is another one."""
        self._sent, self._units = (), None

    def flush(self) -> None:
        """Send what has changed, if anything has."""
        bus, master = self._bus, self._bus.master
        revision = bus.revision
        if revision == self._sent:
            return
        bus.faults.take_events(master)  # a change that they bring is counted already
        units = master.units
        if units is self._units:
            presets = self._presets
            changed = [unit for unit in units.values() if unit.revision > self._changes]
        else:
            presets = link_presets(units.values())
            changed = list(units.values())
        slaves = [describe_slave(bus, unit, presets) for unit in changed]
        if not units:
            slaves = expected_slaves(bus)
        message = BusChange(
            bus=self._number,
            is_up=bus.is_up,
            fault=bus.fault,
            stations=tuple(units) or tuple(slave.station for slave in slaves),
            slaves=tuple(slaves),
        )
        if self._send(message):
            self._sent, self._units = revision, units
            self._presets, self._changes = presets, master.changes
