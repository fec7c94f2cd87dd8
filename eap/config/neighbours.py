"""How the router of one station reaches the next one: which door, and which address behind it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from eap.aoe.spec import DoorKind, HopSpec
from eap.aoe.via import ip_hop, read_address
from eap.config.index import Index
from eap.config.structs import Port, Station
from eap.ids import MacAddr, NetId
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
        hop = ip_hop(own[1], uri, target)
        bits = (int(read_address(uri.host)) ^ int(read_address(target.host))).bit_length()
        return None if hop is None else (hop, bits)
    if uri.scheme == target.scheme == "ethernet":
        port, there = index.ports[own], index.ports[other]
        if is_wanted or (uri.host == target.host and _vid(port) == _vid(there)):
            address = MacAddr.parse(there.mac) if there.mac else NetId.parse(there.net_id)
            return HopSpec(DoorKind.ETHERNET, own[1], str(address)), 0
    return None


def _vid(port: Port) -> int:
    return port.vlan.id if port.vlan else 0
