"""Subscriptions of running stations and of plant files, compared with a PD on the network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from eap.codec import datatypes
from eap.codec.ethercat import EAP_PORT
from eap.control.device import EXPORT
from eap.errors import ControlError
from eap.ids import NetId
from eap.ops.client import connect_those
from eap.pd.observer import ObservedPdKey
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, StationSpec
from eap.pd.words import PdDropReason


class Taker(NamedTuple):
    """One subscription of a station."""

    station: str
    port: PortSpec
    subscription: RxPdSpec
    layouts: frozenset[tuple[int, int]]
    """Version and length of each layout that it takes, the usual one included."""
    length: int

    @property
    def name(self) -> str:
        """``STATION/PD``, as the plant file and ``eapctl status`` name it."""
        return f"{self.station}/{self.subscription.name}"

    def refusal(self, pd: ObservedPdKey) -> PdDropReason | None:
        """Return the reason for which this subscription drops *pd*, None if it takes it."""
        wanted = self.subscription
        if wanted.publisher and NetId.parse(wanted.publisher) != pd.publisher:
            return PdDropReason.WRONG_PUBLISHER
        if (pd.version, pd.length) in self.layouts:
            return None
        if pd.version != wanted.version and not wanted.ignore_version:
            return PdDropReason.VERSION
        return None if pd.length == self.length else PdDropReason.LENGTH

    def is_reached(self, pd: ObservedPdKey) -> bool:
        """Return whether frames to the destination of *pd* can arrive at its port.

        The host's own MAC addresses are not known here: any counts as reached.
        """
        uri = self.port.interface
        if uri.scheme == "loop":
            return False
        if pd.transport == "ethernet":
            return uri.scheme == "ethernet" and self.port.vlan_id == (pd.vlan_id or 0)
        if uri.scheme not in {"udp", "tcp"}:
            return False
        host, _, number = pd.destination.partition(":")
        if int(number or EAP_PORT) != (uri.port or EAP_PORT):
            return False
        is_group = pd.destination_kind != "unicast"
        return is_group or uri.host in {host, "0.0.0.0"}  # noqa: S104  a comparison


def takers_of(stations: Iterable[StationSpec]) -> list[Taker]:
    """Return all subscriptions of *stations*."""
    found = []
    for station in stations:
        ports = {port.name: port for port in station.ports if port.kind is PortKind.EAP}
        types = {each.name: each.type for each in station.variables}
        for each in station.subscriptions:
            size = _size([types[name] for name in each.variables])
            layouts = {(each.version, size)}
            layouts |= {
                (alternate.version, _size([variable.type for variable in alternate.variables]))
                for alternate in each.alternates
            }
            port = ports[each.port]
            found.append(Taker(station.name, port, each, frozenset(layouts), size))
    return found


def _size(types: Sequence[str]) -> int:
    return datatypes.layout([datatypes.parse(each) for each in types]).size


def running_stations() -> tuple[list[StationSpec], list[ControlError]]:
    """Return all stations that run on this host, and the errors of appliances without an answer."""
    found: list[StationSpec] = []
    errors: list[ControlError] = []
    try:
        clients = connect_those(lambda _: True)
    except ControlError as exc:
        return [], [exc]
    for client in clients:
        with client:
            try:
                names = client.info.stations
                found += [client.call(EXPORT, station=name).spec for name in names]
            except ControlError as exc:
                errors.append(exc)
    return found, errors
