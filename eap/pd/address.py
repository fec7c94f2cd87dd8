"""Destinations at run time: as one word of the process image, and as the NetID that one may be.

The word is the kind, then a MAC address, or an IPv4 address and the port.
"""

from __future__ import annotations

from ipaddress import IPv4Address

from eap.ids import Destination, DestinationKind, MacAddr, NetId

_KIND_SHIFT = 48
_KINDS = {DestinationKind.MAC: 1, DestinationKind.IP: 2, DestinationKind.TCP: 3}
_BY_NUMBER = {number: kind for kind, number in _KINDS.items()}
_MAC_SIZE = 6
_LOW = (1 << _KIND_SHIFT) - 1


def to_word(destination: str) -> int:
    """Return *destination* as a word, 0 for one that is no address of a network."""
    try:
        kind, host, port = Destination.parse(destination)
    except ValueError:
        return 0
    if kind not in _KINDS:
        return 0
    if kind is DestinationKind.MAC:
        address = int.from_bytes(MacAddr.parse(host))
    else:
        address = int(IPv4Address(host)) << 16 | port
    return _KINDS[kind] << _KIND_SHIFT | address


def source_word(source: bytes) -> int:
    """Return the address that a frame came from as a word: MAC or IPv4, 0 for none."""
    if len(source) == _MAC_SIZE:
        return _KINDS[DestinationKind.MAC] << _KIND_SHIFT | int.from_bytes(source)
    if not source:
        return 0
    return _KINDS[DestinationKind.IP] << _KIND_SHIFT | int.from_bytes(source) << 16


def source_text(word: int) -> str | None:
    """Return the address that :func:`source_word` made a word of, None for 0."""
    where = from_word(word)
    return None if where is None else where.host


def source_octets(text: str) -> bytes:
    """Return the address *text*, a MAC or an IPv4 address, as origins of frames give it.

    Raises:
        ValueError: it is neither.
    """
    return MacAddr.parse(text) if ":" in text or "-" in text else IPv4Address(text).packed


def is_group_source(source: bytes) -> bool:
    """Tell whether *source* is a group's or everybody's address, which no sender has."""
    if len(source) == _MAC_SIZE:
        return MacAddr(source).is_group
    address = IPv4Address(source)
    return address.is_multicast or address == IPv4Address(0xFFFFFFFF)


def address_text(source: bytes) -> str:
    """Return the address that a frame came from as people write it."""
    return str(MacAddr(source)) if len(source) == _MAC_SIZE else str(IPv4Address(source))


def from_word(word: int) -> Destination | None:
    """Return what :func:`to_word` made a word of, None for 0."""
    kind = _BY_NUMBER.get(word >> _KIND_SHIFT)
    if kind is None:
        return None
    address = word & _LOW
    if kind is DestinationKind.MAC:
        return Destination(kind, str(MacAddr(address.to_bytes(6))))
    return Destination(kind, str(IPv4Address(address >> 16)), address & 0xFFFF)


def net_id_of(destination: str) -> NetId | None:
    """Return the NetID that *destination* is, None if it is something else."""
    try:
        kind, host, _ = Destination.parse(destination)
    except ValueError:
        return None
    return NetId.parse(host) if kind is DestinationKind.NET_ID else None
