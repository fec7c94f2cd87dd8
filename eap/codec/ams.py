"""AMS packets: the header in front of every ADS service, and the prefix of AMS/TCP.

The same packet travels in a mailbox message of type AoE, behind a frame header of type 2, and
behind the prefix of AMS/TCP.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

from eap.codec.wire import Buffer, WireStruct, net_id, u16, u32
from eap.errors import MalformedError, TruncatedError
from eap.ids import NetId

SYSTEM_PORT = 10_000
"""AMS port of the system service, which routers have."""
IO_PORT = 300
"""AMS port of the I/O server, which knows the masters of a station."""
DEVICE_PORT = 0xFFFF
"""AMS port of an EAP device, of a master, and of the dictionary of a router."""
CONTROL_PORT = 17_729
"""AMS port of the control protocol of an appliance, at the NetIDs of its routers; own format."""

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
        """Return the name of a command, or its number for an undocumented one."""
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


# Plain numbers: members of enums and operators of flags are slow.
_RESPONSE = StateFlags.RESPONSE.value
_NO_RETURN = StateFlags.NO_RETURN.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value


class AmsHeader(WireStruct, frozen=True):
    """Beckhoff ADS specification, AMS header: target, source and service.

    *command* stays a number when :class:`AmsCommand` does not know it: a router forwards such a
    packet, and its target answers that it does not know the service.  *length* is the number of
    bytes behind the header, *invoke_id* pairs a response with its request.
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

    @property
    def wants_answer(self) -> bool:
        """True if the sender of this request waits for an answer."""
        return not (self.state_flags & _NO_RETURN or self.command == _NOTIFICATION)


_HEADER = AmsHeader.LAYOUT


def decode_packet(data: Buffer, offset: int = 0) -> tuple[AmsHeader, memoryview]:
    """Return header and data of the packet at *offset*; surplus bytes behind it are ignored.

    Raises TruncatedError if fewer bytes follow than the header says.
    """
    header = AmsHeader.decode(data, offset)
    start = offset + AmsHeader.SIZE
    body = memoryview(data)[start : start + header.length]
    if len(body) < header.length:
        raise TruncatedError(
            f"length {header.length}, but {len(body)} bytes follow",
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


class AmsAnswer(NamedTuple):
    """Answer of a service to a request."""

    data: bytes = b""
    error_code: int = 0
    """Of the AMS header: the reason the request was not delivered."""
    why: str = ""
    """Reason for operators, where results inside *data* refuse something."""


def response_to(header: AmsHeader, answer: AmsAnswer) -> bytes:
    """Return the packet with *answer* to the request with *header*."""
    data = answer.data
    # Packed at once: a station does this for each request.
    head = _HEADER.pack(
        header.source,
        header.source_port,
        header.target,
        header.target_port,
        header.command,
        header.state_flags | _RESPONSE,
        len(data),
        answer.error_code,
        header.invoke_id,
    )
    return head + data


AMS_TCP_PORT = 48898
_LENGTH_AT = 16
"""Bit of the prefix; *reserved* is before it."""


class RouterCommand(IntEnum):
    """Commands of a local client to a router, in *reserved* of the prefix.

    As the open client ads-client sends them; Beckhoff documents none.
    """

    CLOSE_PORT = 0x0001
    """With a port of 16 bits; the connection is closed then."""
    OPEN_PORT = 0x1000
    """With a port, 0 for any; answered with NetID and port."""
    NET_ID = 0x1002
    """Answered with the NetID."""


class AmsTcpHeader(WireStruct, frozen=True):
    """Beckhoff ADS specification, AMS/TCP header; *length* counts the bytes of the packet.

    *reserved* is 0 in front of a packet; behind a :class:`RouterCommand` there is no AMS header.
    """

    reserved: u16 = 0
    length: u32 = 0


def decode_prefix(data: Buffer, offset: int = 0) -> int:
    """Return the number of bytes of the packet whose prefix is at *offset*.

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
    # Reserved is 0, so the prefix is one number of six bytes.
    return (len(packet) << _LENGTH_AT).to_bytes(AmsTcpHeader.SIZE, "little") + packet


def encode_opened_port(net_id: NetId, port: int) -> bytes:
    """Return the answer to OPEN_PORT."""
    return _encode_command(RouterCommand.OPEN_PORT, net_id + port.to_bytes(2, "little"))


def encode_net_id(net_id: NetId) -> bytes:
    """Return the answer to NET_ID."""
    return _encode_command(RouterCommand.NET_ID, net_id)


def _encode_command(command: RouterCommand, data: bytes) -> bytes:
    return AmsTcpHeader(command, len(data)).encode() + data
