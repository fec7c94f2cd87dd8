"""How the router of one station reaches the next one: which door, and which address behind it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.aoe.spec import DoorKind, HopSpec
from eap.codec.ethercat import EAP_PORT
from eap.config.index import Index
from eap.config.structs import Port, Station
from eap.ids import InterfaceUri, MacAddr, NetId
from eap.pd.spec import PortKind

_IP_SCHEMES = {"udp", "tcp"}
_PREFERENCE = (DoorKind.UDP, DoorKind.TCP, DoorKind.ETHERNET)
"""UDP first: it needs no connection, and the kernel knows who has an address."""


class _Candidate(NamedTuple):
    """A way from port to port; the smallest one is taken."""

    preference: int
    differing_bits: int
    """Of IPv4 addresses, from the first one that differs on: hosts of one network come first."""
    order: int
    hop: HopSpec


def find_hop(
    index: Index, station: Station, target: Station, *, own: str = "", other: str = ""
) -> HopSpec | None:
    """Return how packets go from *station* to *target* directly, None if no interface is shared.

    Interfaces are taken for shared if both are of IP, on this host or both not, or if they are
    Ethernet interfaces of one name and VLAN.

    Args:
        index: The plant.
        station: From where.
        target: To where; another station.
        own: The port to leave by; any if empty.
        other: The port to arrive at; any if empty.
    """
    found = (
        _hop(index, (station.name, mine), (target.name, theirs), is_wanted=bool(other))
        for mine in _eap_ports(index, station, own)
        for theirs in _eap_ports(index, target, other)
    )
    ranked = [
        _Candidate(_PREFERENCE.index(hop.kind), bits, order, hop)
        for order, each in enumerate(found)
        if each is not None
        for hop, bits in [each]
    ]
    return min(ranked).hop if ranked else None


def _eap_ports(index: Index, station: Station, name: str) -> Iterator[str]:
    for port in station.ports:
        known = port.kind is PortKind.EAP and (station.name, port.name) in index.uris
        if known and name in {"", port.name}:
            yield port.name


def _hop(
    index: Index, own: tuple[str, str], other: tuple[str, str], *, is_wanted: bool
) -> tuple[HopSpec, int] | None:
    """Return the hop from port to port, and how many bits of their addresses differ.

    With *is_wanted* somebody said that it is there, whatever the names of the interfaces are.
    """
    uri, target = index.uris[own], index.uris[other]
    if uri.scheme in _IP_SCHEMES and target.scheme in _IP_SCHEMES:
        return _ip_hop(own[1], uri, target)
    if uri.scheme == target.scheme == "ethernet":
        port, there = index.ports[own], index.ports[other]
        if is_wanted or (uri.host == target.host and _vid(port) == _vid(there)):
            address = MacAddr.parse(there.mac) if there.mac else NetId.parse(there.net_id)
            return HopSpec(DoorKind.ETHERNET, own[1], str(address)), 0
    return None


def _ip_hop(port: str, uri: InterfaceUri, target: InterfaceUri) -> tuple[HopSpec, int] | None:
    here, there = _address(uri.host), _address(target.host)
    if there.is_unspecified or (not here.is_unspecified and here.is_loopback != there.is_loopback):
        return None
    kind = DoorKind.UDP if uri.scheme == target.scheme == "udp" else DoorKind.TCP
    hop = HopSpec(kind, port, f"{target.host}:{target.port or EAP_PORT}")
    return hop, (int(here) ^ int(there)).bit_length()


@cache
def _address(host: str) -> IPv4Address:
    """Read an address that is one of very many pairs in a large plant."""
    return IPv4Address(host)


def _vid(port: Port) -> int:
    return port.vlan.id if port.vlan else 0
