"""Which device a command means, and the way to its object dictionary.

An EAP port, a router or a slave of a station that runs here is reached by its appliance; everything
else by ADS, through the routes of the first appliance that knows it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, Self

from eap.appliance.commands.ams_device import open_ams
from eap.appliance.commands.client import Client, connect_station
from eap.appliance.commands.od_device import OdDevice
from eap.appliance.commands.od_station import StationOd
from eap.appliance.runtime import find_running
from eap.ids import NetId

_OCTETS = 6
_NOT_THERE = "is no STATION, STATION/PORT or STATION/PORT/SLAVE, and no NETID[:PORT]"


class Target(NamedTuple):
    """A device by name or address; *plant* chooses where several plants run the station."""

    station: str
    """Or ``NETID[:PORT]``."""
    port: str = ""
    """Empty: the first EAP port."""
    slave: str = ""
    """Of a bus port."""
    plant: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``; raise ValueError otherwise."""
        parts = text.split("/")
        if len(parts) > 3 or not all(parts):
            raise ValueError(f"{text!r} {_NOT_THERE}")
        if text.count(".") == _OCTETS - 1 and len(parts) == 1:
            NetId.parse(text.partition(":")[0])
        return cls(*parts)

    @property
    def is_address(self) -> bool:
        """Whether it is a NetID, and no name."""
        return not self.port and self.station.count(".") == _OCTETS - 1

    @property
    def is_here(self) -> bool:
        """Whether its station runs here, or nothing does."""
        running = [info for _, info in find_running()]
        chosen = [info for info in running if self.plant in {None, info.plant}]
        names = {name for info in chosen for name in info.stations}
        return not chosen or (not self.is_address and self.station in names)

    def __str__(self) -> str:
        return "/".join(part for part in self[:3] if part)


@contextmanager
def open_device(target: Target) -> Iterator[OdDevice]:
    """Reach the object dictionary of *target*, for the length of a block.

    Raises:
        ControlError: nobody runs the station or knows the way to it, or several run it and its
            plant is left open.
        BusError: the bus has no such slave.
    """
    if not target.is_here:
        with _open_far(target) as device:
            yield device
    elif target.slave:
        from eap.appliance.commands.bus_running import open_running  # a master, for slaves alone
        from eap.appliance.commands.od_slave import SlaveOd

        with open_running(target.station, target.port, target.plant) as bus:
            yield SlaveOd(bus, target.slave)
    else:
        with connect_station(target.station, target.plant) as client:
            if not is_bus(client, target):
                yield StationOd(client, str(target))
                return
        with _open_far(target) as device:
            yield device


def is_bus(client: Client, target: Target) -> bool:
    """Say whether *target* is a bus port of a station that runs here: its master."""
    if not target.port or target.slave:
        return False
    stations = client.request("status")["stations"]
    return any(
        port["name"] == target.port and port["kind"] == "bus"
        for station in stations
        if station["name"] == target.station
        for port in station["ports"]
    )


@contextmanager
def _open_far(target: Target) -> Iterator[OdDevice]:
    from eap.appliance.commands.od_ads import AdsOd

    with open_ams(str(target), target.plant) as device:
        yield AdsOd(device)
