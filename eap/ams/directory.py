"""Names of a plant and the AMS addresses behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from eap.ams.spec import DirectoryPort, DirectoryStation
from eap.codec.ams import DEVICE_PORT, SYSTEM_PORT
from eap.ids import NetId
from eap.od.profiles.router9000 import ROUTER
from eap.suggest import suggest

_MAX_PORT = 0xFFFF


class AmsAddress(NamedTuple):
    """Whom an ADS request is for."""

    net_id: NetId
    port: int

    def __str__(self) -> str:
        return f"{self.net_id}:{self.port}"


class Directory:
    """All stations of a plant, with their ports and slaves."""

    def __init__(self, stations: Sequence[DirectoryStation]) -> None:
        self.stations = {station.name: station for station in stations}
        self._names = {
            AmsAddress(station.net_id, SYSTEM_PORT): station.name for station in stations
        }
        self._net_ids = {station.net_id: station.name for station in stations}
        for station in stations:
            own = AmsAddress(station.net_id, DEVICE_PORT)
            self._names[own] = f"{station.name}/{ROUTER}"
            for port in station.ports:
                self._enter(f"{station.name}/{port.name}", port)

    def find(self, text: str) -> AmsAddress:
        """Return the address of ``STATION``, ``STATION/PORT[/SLAVE]`` or ``NETID[:PORT]``.

        A station stands for the system service of its router, ``STATION/router`` for the router's
        dictionary.

        Raises:
            ValueError: there is no such name here, or it is no name; the message says what is.
        """
        if text.count(".") == 5 and "/" not in text:
            return _parse(text)
        name, _, rest = text.partition("/")
        station = self.stations.get(name)
        if station is None:
            raise ValueError(f"no station {name!r} in this plant{suggest(name, self.stations)}")
        if not rest:
            return AmsAddress(station.net_id, SYSTEM_PORT)
        port_name, slash, slave = rest.partition("/")
        ports = {port.name: port for port in station.ports}
        port = ports.get(port_name)
        if port is None and rest == ROUTER:
            return AmsAddress(station.net_id, DEVICE_PORT)
        if port is None:
            hint = suggest(port_name, ports) or f"; it has {', '.join(ports) or 'none'}"
            raise ValueError(f"station {name} has no port {port_name!r}{hint}")
        number = _slave(f"{name}/{port_name}", port, slave) if slash else DEVICE_PORT
        return AmsAddress(port.net_id, number)

    def find_device(self, text: str) -> AmsAddress:
        """As :meth:`find`, but a station stands for its first EAP port, if it has one."""
        station = self.stations.get(text)
        ports = () if station is None else station.ports
        first = next((port for port in ports if not port.is_bus), None)
        return self.find(text if first is None else f"{text}/{first.name}")

    def name_of(self, net_id: NetId, port: int) -> str:
        """Return who has an address, as people call it; empty if nobody here knows."""
        known = self._names.get(AmsAddress(net_id, port))
        if known is not None:
            return known
        owner = self._net_ids.get(net_id)
        return "" if owner is None else f"{owner}:{port}"

    def station_of(self, net_id: NetId) -> str:
        """Return the station that has a NetID, also one of its ports; empty if nobody here does."""
        return self._net_ids.get(net_id, "").partition("/")[0]

    def _enter(self, name: str, port: DirectoryPort) -> None:
        net_id = port.net_id
        self._net_ids.setdefault(net_id, name)
        self._names[AmsAddress(net_id, DEVICE_PORT)] = name
        for slave, number in port.slaves.items():
            self._names[AmsAddress(net_id, number)] = f"{name}/{slave}"


def _parse(text: str) -> AmsAddress:
    net_id, colon, port = text.partition(":")
    if not colon:
        return AmsAddress(NetId.parse(net_id), DEVICE_PORT)
    if not (port.isascii() and port.isdigit() and int(port) <= _MAX_PORT):
        raise ValueError(f"{port!r} in {text!r} is no AMS port (0 to {_MAX_PORT})")
    return AmsAddress(NetId.parse(net_id), int(port))


def _slave(owner: str, port: DirectoryPort, slave: str) -> int:
    if not port.is_bus:
        raise ValueError(f"{owner} is no bus port, so there are no slaves behind it")
    if slave in port.slaves:
        return port.slaves[slave]
    if slave.isascii() and slave.isdigit() and 0 < int(slave) < DEVICE_PORT:
        return int(slave)
    known = ", ".join(f"{name} ({number})" for name, number in port.slaves.items())
    hint = suggest(slave, port.slaves) or (f"; they are {known}" if known else "")
    raise ValueError(f"no slave {slave!r} behind {owner}{hint}")
