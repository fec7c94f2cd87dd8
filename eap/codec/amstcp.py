"""AMS/TCP: the prefix in front of each AMS packet on a TCP connection."""

from __future__ import annotations

from enum import IntEnum

from eap.codec.ams import AmsHeader
from eap.codec.wire import Buffer, WireStruct, u16, u32
from eap.errors import MalformedError
from eap.ids import NetId

AMS_TCP_PORT = 48898
_LENGTH_AT = 16
"""Bit of the prefix; *reserved* is before it."""


class RouterCommand(IntEnum):
    """What a local client asks a router itself, in *reserved* of the prefix.

    As the open client ads-client sends them; Beckhoff documents none.
    """

    CLOSE_PORT = 0x0001
    """With a port of 16 bits; the connection is closed then."""
    OPEN_PORT = 0x1000
    """With a port, 0 for any; answered with NetID and port."""
    NET_ID = 0x1002
    """Answered with the NetID."""


class AmsTcpHeader(WireStruct, frozen=True):
    """Beckhoff ADS specification, AMS/TCP header; *length* counts the octets of the packet.

    *reserved* is 0 in front of a packet; behind a :class:`RouterCommand` there is no AMS header.
    """

    reserved: u16 = 0
    length: u32 = 0


def decode_prefix(data: Buffer, offset: int = 0) -> int:
    """Return how many octets the packet has whose prefix is at *offset*.

    Raises:
        TruncatedError: the prefix is not whole.
        MalformedError: what follows is no AMS packet.
    """
    prefix = AmsTcpHeader.decode(data, offset)
    if prefix.reserved:
        raise MalformedError(
            f"reserved is 0x{prefix.reserved:04x}, expected 0", layout="AmsTcpHeader", offset=offset
        )
    if prefix.length < AmsHeader.SIZE:
        raise MalformedError(
            f"length {prefix.length}, expected {AmsHeader.SIZE} or more",
            layout="AmsTcpHeader",
            offset=offset,
        )
    return prefix.length


def encode_with_prefix(packet: bytes) -> bytes:
    """Return a whole AMS packet with its prefix."""
    return (len(packet) << _LENGTH_AT).to_bytes(AmsTcpHeader.SIZE, "little") + packet


def encode_opened_port(net_id: NetId, port: int) -> bytes:
    """Return what tells a local client its AMS address."""
    return _encode_command(RouterCommand.OPEN_PORT, net_id + port.to_bytes(2, "little"))


def encode_net_id(net_id: NetId) -> bytes:
    """Return what tells a local client its NetID."""
    return _encode_command(RouterCommand.NET_ID, net_id)


def _encode_command(command: RouterCommand, data: bytes) -> bytes:
    return AmsTcpHeader(command, len(data)).encode() + data
