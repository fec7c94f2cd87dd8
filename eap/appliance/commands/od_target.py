"""Which device a command means: an EAP port of a running station, or a slave behind a bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, Self

from eap.appliance.commands.client import connect_station
from eap.appliance.commands.od_device import OdDevice
from eap.appliance.commands.od_station import StationOd


class Target(NamedTuple):
    """A device by name; *plant* chooses where several plants run the station."""

    station: str
    port: str = ""
    """Empty: the first EAP port."""
    slave: str = ""
    """Of a bus port."""
    plant: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``STATION[/PORT[/SLAVE]]``; raise ValueError otherwise."""
        parts = text.split("/")
        if len(parts) > 3 or not all(parts):
            raise ValueError(f"{text!r} is no STATION, STATION/PORT or STATION/PORT/SLAVE")
        return cls(*parts)

    def __str__(self) -> str:
        return "/".join(part for part in self[:3] if part)


@contextmanager
def open_device(target: Target) -> Iterator[OdDevice]:
    """Reach the object dictionary of *target*, for the length of a block.

    Raises:
        ControlError: nobody runs the station, or several do and its plant is left open.
        BusError: the bus has no such slave.
    """
    if target.slave:
        from eap.appliance.commands.bus_running import open_running  # a master, for slaves alone
        from eap.appliance.commands.od_slave import SlaveOd

        with open_running(target.station, target.port, target.plant) as bus:
            yield SlaveOd(bus, target.slave)
    else:
        with connect_station(target.station, target.plant) as client:
            yield StationOd(client, str(target))
