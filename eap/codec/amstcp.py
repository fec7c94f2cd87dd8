"""AMS/TCP: the prefix in front of each AMS packet on a TCP connection."""

from __future__ import annotations

from eap.codec.ams import AmsHeader
from eap.codec.wire import Buffer, WireStruct, u16, u32
from eap.errors import MalformedError

AMS_TCP_PORT = 48898
_LENGTH_AT = 16
"""Bit of the prefix; *reserved* is before it."""


class AmsTcpHeader(WireStruct, frozen=True):
    """Beckhoff ADS specification, AMS/TCP header; *length* counts the octets of the packet.

    *reserved* is 0 in front of a packet.  Local clients of a TwinCAT router put other numbers
    there, to be given a port or the NetID: there is no AMS header behind those.
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
