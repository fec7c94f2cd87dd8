"""AMS packets: the header in front of every ADS service.

The same packet travels in a mailbox message of type AoE, behind a frame header of type 2, and
behind the prefix of AMS/TCP.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag

from eap.codec.wire import Buffer, WireStruct, net_id, u16, u32
from eap.errors import TruncatedError

SYSTEM_PORT = 10_000
"""AMS port of the system service, which routers have."""
IO_PORT = 300
"""AMS port of the I/O server, which knows the masters of a station."""
DEVICE_PORT = 0xFFFF
"""AMS port of an EAP device, of a master, and of the dictionary of a router."""

ADDRESSES = struct.Struct("<6sH6sH")
"""The head of an AMS header by itself: target and source, a NetID and a port each."""


class AmsCommand(IntEnum):
    """The ADS services, and the fragment of a packet too long for a mailbox."""

    READ_DEVICE_INFO = 1
    READ = 2
    WRITE = 3
    READ_STATE = 4
    WRITE_CONTROL = 5
    ADD_NOTIFICATION = 6
    DELETE_NOTIFICATION = 7
    NOTIFICATION = 8
    READ_WRITE = 9
    FRAGMENT = 0x0902

    @classmethod
    def name_of(cls, command: int) -> str:
        """Return the name of a command, or its number for one nobody documents."""
        return cls(command).name if command in cls._value2member_map_ else f"0x{command:04x}"


class StateFlags(IntFlag):
    """Bits of the field *state_flags*: a request is ADS, its response RESPONSE and ADS."""

    RESPONSE = 0x0001
    NO_RETURN = 0x0002
    ADS = 0x0004
    SYSTEM = 0x0008
    HIGH_PRIORITY = 0x0010
    TIME_STAMP = 0x0020
    UDP = 0x0040
    INIT = 0x0080
    BROADCAST = 0x8000


class AmsHeader(WireStruct, frozen=True):
    """Beckhoff ADS specification, AMS header: from whom, to whom, which service.

    *command* stays a number when :class:`AmsCommand` does not know it: a router passes such a
    packet on, and its target answers that it does not know the service.  *length* is the number of
    octets behind the header, *invoke_id* pairs a response with its request.
    """

    target: net_id
    target_port: u16
    source: net_id
    source_port: u16
    command: u16
    state_flags: u16 = StateFlags.ADS
    length: u32 = 0
    error_code: u32 = 0
    invoke_id: u32 = 0


def decode_packet(data: Buffer, offset: int = 0) -> tuple[AmsHeader, memoryview]:
    """Return header and data of the packet at *offset*; surplus octets behind it are ignored.

    Raises TruncatedError if fewer octets follow than the header says.
    """
    header = AmsHeader.decode(data, offset)
    start = offset + AmsHeader.SIZE
    body = memoryview(data)[start : start + header.length]
    if len(body) < header.length:
        raise TruncatedError(
            f"length {header.length}, but {len(body)} octets follow",
            layout="AmsHeader",
            offset=offset,
        )
    return header, body


def encode_packet(header: AmsHeader, body: Buffer) -> bytes:
    """Return a whole packet; the length is set from *body*."""
    return AmsHeader(
        header.target,
        header.target_port,
        header.source,
        header.source_port,
        header.command,
        header.state_flags,
        len(body),
        header.error_code,
        header.invoke_id,
    ).encode() + bytes(body)
