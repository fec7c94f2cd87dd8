"""EoE messages: Ethernet frames and IP settings through a mailbox (ETG.1000.6)."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from ipaddress import IPv4Address
from typing import Annotated, Self

import msgspec

from eap.codec.wire import Bits, Buffer, WireStruct, bit, bits4, bits6, u16, u32
from eap.errors import CodecError, TruncatedError
from eap.ids import MacAddr

DATA_OVERHEAD = 10
"""Bytes of a mailbox that a fragment takes before its data."""
FRAGMENT_UNIT = 32
"""Every fragment but the last is a multiple of so many bytes."""
NAME_SIZE = 32


class EoeType(IntEnum):
    """ETG.1000.6, EoE header: what a message is."""

    FRAGMENT = 0
    TIME_STAMP_RESPONSE = 1
    SET_IP_REQUEST = 2
    SET_IP_RESPONSE = 3
    SET_FILTER_REQUEST = 4
    SET_FILTER_RESPONSE = 5
    GET_IP_REQUEST = 6
    GET_IP_RESPONSE = 7
    GET_FILTER_REQUEST = 8
    GET_FILTER_RESPONSE = 9


REQUESTS = frozenset(
    (
        EoeType.SET_IP_REQUEST,
        EoeType.SET_FILTER_REQUEST,
        EoeType.GET_IP_REQUEST,
        EoeType.GET_FILTER_REQUEST,
    )
)
"""Messages that are answered; Ethernet frames are not."""
READS = frozenset((EoeType.GET_IP_REQUEST, EoeType.GET_FILTER_REQUEST))
"""Those that change nothing."""


class EoeResult(IntEnum):
    """ETG.1000.6, EoE result codes; a peer may send others, which stay plain integers."""

    OK = 0x0000
    UNSPECIFIED = 0x0001
    UNSUPPORTED_TYPE = 0x0002
    NO_IP = 0x0201
    NO_DHCP = 0x0202
    NO_FILTER = 0x0401


_TEXTS = {
    EoeResult.OK: "done",
    EoeResult.UNSPECIFIED: "error without a reason",
    EoeResult.UNSUPPORTED_TYPE: "type of message not supported",
    EoeResult.NO_IP: "IP is not supported",
    EoeResult.NO_DHCP: "DHCP is not supported",
    EoeResult.NO_FILTER: "address filters are not supported",
}


def name_of(result: int) -> str:
    """Return the meaning of *result*, which may be of the vendor."""
    try:
        return _TEXTS[EoeResult(result)]
    except ValueError:
        return "result code of the vendor"


class EoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: the first word of every message; *port* 0 is any."""

    type: Annotated[EoeType, Bits(4, EoeType)]
    port: bits4 = 0
    last: bit = 0
    time_appended: bit = 0
    time_requested: bit = 0
    reserved: Annotated[int, Bits(5)] = 0


class FragmentWord(WireStruct, frozen=True):
    """ETG.1000.6: the second word of a fragment.

    *offset* counts units of 32 bytes; in fragment 0 it is the size of the whole frame in them,
    rounded up.  *frame* numbers the frames from 0 to 15.
    """

    fragment: bits6
    offset: bits6
    frame: bits4


class ResultWord(WireStruct, frozen=True):
    """ETG.1000.6: the second word of a response, as :class:`EoeResult`, and of other requests."""

    result: u16 = 0


class _Flag(IntFlag):
    MAC = 0x01
    IP = 0x02
    MASK = 0x04
    GATEWAY = 0x08
    DNS = 0x10
    NAME = 0x20


class _Flags(WireStruct, frozen=True):
    flags: u32


class IpSettings(msgspec.Struct, frozen=True):
    """ETG.1000.6, set and get IP: the Ethernet settings of a slave, None where none is given."""

    mac: MacAddr | None = None
    ip: IPv4Address | None = None
    mask: IPv4Address | None = None
    gateway: IPv4Address | None = None
    dns: IPv4Address | None = None
    name: str | None = None

    def encode(self) -> bytes:
        """Return the body of a message; raise CodecError if the name is longer than 32 bytes."""
        flags = 0
        octets = b""
        parts = (
            (_Flag.MAC, self.mac),
            (_Flag.IP, _reversed(self.ip)),
            (_Flag.MASK, _reversed(self.mask)),
            (_Flag.GATEWAY, _reversed(self.gateway)),
            (_Flag.DNS, _reversed(self.dns)),
            (_Flag.NAME, _name(self.name)),
        )
        for flag, part in parts:
            if part is not None:
                flags |= flag
                octets += part
        return _Flags(flags).encode() + octets

    @classmethod
    def decode(cls, body: Buffer) -> Self:
        """Read the body of a message; raise TruncatedError if it lacks what it says to hold."""
        flags = _Flags.decode(body).flags
        view = memoryview(body)[_Flags.SIZE :]

        def take(flag: _Flag, size: int) -> bytes | None:
            nonlocal view
            if not flags & flag:
                return None
            part, view = bytes(view[:size]), view[size:]
            # Some masters cut the name to its length instead of padding it.
            if len(part) < size and flag is not _Flag.NAME:
                raise TruncatedError(f"{flag.name} is not all there", layout="IpSettings")
            return part

        def address(flag: _Flag) -> IPv4Address | None:
            part = take(flag, 4)
            return None if part is None else IPv4Address(part[::-1])

        mac = take(_Flag.MAC, 6)
        ip, mask, gateway, dns = map(address, (_Flag.IP, _Flag.MASK, _Flag.GATEWAY, _Flag.DNS))
        name = take(_Flag.NAME, NAME_SIZE)
        # All 32 bytes may be used: a NUL ends only a shorter name.
        text = None if name is None else name.partition(b"\0")[0].decode(errors="replace")
        return cls(None if mac is None else MacAddr(mac), ip, mask, gateway, dns, text)


def _reversed(address: IPv4Address | None) -> bytes | None:
    # As 32-bit little-endian numbers, the other way round than in IP; so TwinCAT sends them.
    return None if address is None else address.packed[::-1]


def _name(name: str | None) -> bytes | None:
    if name is None:
        return None
    octets = name.encode()
    if len(octets) > NAME_SIZE:
        raise CodecError(
            f"{name!r} has {len(octets)} bytes, expected at most {NAME_SIZE}", layout="IpSettings"
        )
    return octets.ljust(NAME_SIZE, b"\0")


def decode_message(data: Buffer) -> tuple[EoeHeader, int, memoryview]:
    """Return header, second word and body of the data of a mailbox message.

    Raises:
        TruncatedError: it is shorter than the two words.
        MalformedError: the type is unknown.
    """
    header = EoeHeader.decode(data)
    word = ResultWord.decode(data, EoeHeader.SIZE).result
    return header, word, memoryview(data)[EoeHeader.SIZE + ResultWord.SIZE :]


def encode_message(kind: EoeType, body: Buffer = b"", *, result: int = 0, port: int = 0) -> bytes:
    """Return the data of a mailbox message that is no fragment."""
    return EoeHeader(kind, port).encode() + ResultWord(result).encode() + body


COUNT_SIZE = 2


def encode_counted(frame: bytes) -> bytes:
    """Return an Ethernet frame behind its length, as ADS carries several of them (own format)."""
    return len(frame).to_bytes(COUNT_SIZE, "little") + frame


def split_counted(data: bytes) -> list[bytes]:
    """Return the frames that :func:`encode_counted` made; an incomplete one is left out."""
    found = []
    at = 0
    while at + COUNT_SIZE <= len(data):
        start = at + COUNT_SIZE
        at = start + int.from_bytes(data[at:start], "little")
        if start < at <= len(data):
            found.append(data[start:at])
    return found
