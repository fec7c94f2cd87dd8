"""Addresses as value types: NetID, MAC address, object ID, interface URI, destination."""

from __future__ import annotations

import re
from enum import Enum, auto
from functools import lru_cache
from ipaddress import IPv4Address
from typing import NamedTuple, Self
from urllib.parse import parse_qsl, urlencode

STATION_OCTETS = 4
"""Number of leading bytes that all NetIDs of a station usually have in common."""


NET_ID = "six numbers from 0 to 255, such as 5.23.91.23.1.1"
"""Expectation of a finding about a NetID."""


class NetId(bytes):
    """An AMS NetID: six bytes, written ``5.23.91.23.1.1``.  Not an IP address."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read the dotted form; raise ValueError if it is not six bytes."""
        octets = text.split(".")
        if len(octets) != 6 or not all(part.isascii() and part.isdigit() for part in octets):
            raise ValueError(f"{text!r} is not an AMS NetID (six numbers such as 5.23.91.23.1.1)")
        numbers = [int(part) for part in octets]
        if max(numbers) > 255:
            raise ValueError(f"{text!r} has a number above 255")
        return cls(numbers)

    @property
    def station(self) -> bytes:
        """The leading bytes that all NetIDs of its station usually have in common."""
        return self[:STATION_OCTETS]

    def __str__(self) -> str:
        return ".".join(map(str, self))

    def __repr__(self) -> str:
        return f"NetId.parse({str(self)!r})"


def prefix_text(prefix: bytes) -> str:
    """Return the pattern of all NetIDs that begin with *prefix*: ``5.23.91.23.x.x``."""
    return ".".join([*map(str, prefix), *["x"] * (6 - len(prefix))])


_MAC = re.compile(r"[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}")


class MacAddr(bytes):
    """An Ethernet address: six bytes, written ``01:01:05:04:00:00``."""

    __slots__ = ()

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read the form with colons or dashes; raise ValueError if it is not six bytes."""
        if not _MAC.fullmatch(text):
            raise ValueError(f"{text!r} is not a MAC address (six bytes such as 01:01:05:04:00:00)")
        return cls.fromhex(text.replace("-", "").replace(":", ""))

    @property
    def is_group(self) -> bool:
        """True if this is a multicast or the broadcast address."""
        return bool(self[0] & 1)

    def __str__(self) -> str:
        return ":".join(f"{octet:02x}" for octet in self)

    def __repr__(self) -> str:
        return f"MacAddr.parse({str(self)!r})"


_OBJECT_ID = re.compile(r"(?:0[xX])?([0-9A-Fa-f]+)(?::(?:0[xX])?([0-9A-Fa-f]+))?")


class ObjectId(NamedTuple):
    """Index and subindex of an entry of an object dictionary, written ``0x1018:01``.

    Both are hexadecimal in all texts: the field uses no other notation, and
    ``1000:0`` read as decimal would silently be another object.
    """

    object_index: int
    subindex: int = 0

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``INDEX[:SUB]`` in hexadecimal, with or without 0x; raise ValueError otherwise."""
        match = _OBJECT_ID.fullmatch(text)
        index, subindex = (int(match[1], 16), int(match[2] or "0", 16)) if match else (-1, 0)
        if not 0 <= index <= 0xFFFF or subindex > 0xFF:
            raise ValueError(f"{text!r} is not INDEX[:SUB] in hexadecimal, such as 0x1018:01")
        return cls(index, subindex)

    def __str__(self) -> str:
        return f"0x{self.object_index:04X}:{self.subindex:02X}"


BROADCAST_MAC = MacAddr(b"\xff" * 6)
EAP_MULTICAST_MAC = MacAddr.parse("01:01:05:04:00:00")
"""Default destination of a publisher on Ethernet."""


INTERFACE_SCHEMES = ("udp", "ethernet", "tcp", "loop", "sim")


INTERFACE_NAME_SIZE = 15
"""Bytes of the longest name of an interface in Linux."""


class InterfaceUri:
    """Interface of a port: ``udp://127.0.1.1``, ``ethernet://eth0``, ``loop://line``.

    *host* is an address, an interface name or the name of a loopback; *port* is 0 unless given.

    Equal if all parts are.  In records and on the control socket it is its text.
    """

    # Not a NamedTuple: msgspec would write that as an array, and stored plants hold a text.
    __slots__ = ("host", "options", "port", "scheme")

    def __init__(
        self, scheme: str, host: str, port: int = 0, options: tuple[tuple[str, str], ...] = ()
    ) -> None:
        self.scheme = scheme
        self.host = host
        self.port = port
        self.options = options

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read the URI form; raise ValueError with the reason if it is not one of ours."""
        scheme, separator, rest = text.partition("://")
        if not separator or scheme not in INTERFACE_SCHEMES:
            known = ", ".join(f"{name}://…" for name in INTERFACE_SCHEMES)
            raise ValueError(f"{text!r} is not an interface (one of {known})")
        rest, _, query = rest.partition("?")
        options = tuple(parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query)))
        if scheme in {"udp", "tcp"}:
            host, port = _split_port(rest)
            return cls(scheme, host, port, options)
        if not rest:
            raise ValueError(f"{text!r} names no interface")
        return cls(scheme, rest, 0, options)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, InterfaceUri) and str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))

    def __repr__(self) -> str:
        return f"InterfaceUri.parse({str(self)!r})"

    def __str__(self) -> str:
        port = f":{self.port}" if self.port else ""
        query = f"?{urlencode(self.options)}" if self.options else ""
        return f"{self.scheme}://{self.host}{port}{query}"


def encode_value(value: object) -> str:
    """Return the text of an address in a record (msgspec's ``enc_hook``)."""
    if isinstance(value, NetId | InterfaceUri):
        return str(value)
    # msgspec's sign that a hook does not know the type.
    raise NotImplementedError(f"{type(value).__name__} in a record")


def decode_value(kind: type, text: object) -> NetId | InterfaceUri:
    """Read an address of a record (msgspec's ``dec_hook``); raise ValueError if it is invalid."""
    if kind not in {NetId, InterfaceUri}:
        raise NotImplementedError(f"{kind.__name__} in a record")
    if not isinstance(text, str):
        # msgspec reports a ValueError as a ValidationError with the path of the field.
        raise ValueError(f"Expected `str`, got `{type(text).__name__}`")  # noqa: TRY004
    return NetId.parse(text) if kind is NetId else InterfaceUri.parse(text)


class DestinationKind(Enum):
    """Kind of the destination address of a frame."""

    MAC = auto()
    IP = auto()
    TCP = auto()
    NET_ID = auto()


class Destination(NamedTuple):
    """Destination of a frame: a MAC address, an IPv4 address, ``tcp://`` and one, or a NetID.

    A NetID stands for the MAC address of the port that has it.
    """

    kind: DestinationKind
    host: str
    port: int = 0
    """UDP or TCP port, 0 for the usual one."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read any of the forms; raise ValueError if it is none of them."""
        if text.startswith("tcp://"):
            return cls(DestinationKind.TCP, *_split_port(text[6:]))
        if text.count(":") == 5 or text.count("-") == 5:
            return cls(DestinationKind.MAC, str(MacAddr.parse(text)))
        if text.count(".") == 5:
            return cls(DestinationKind.NET_ID, str(NetId.parse(text)))
        return cls(DestinationKind.IP, *_split_port(text))

    @property
    def is_group(self) -> bool:
        """True if more than one station may listen there (multicast, or 255.255.255.255)."""
        if self.kind is DestinationKind.MAC:
            return MacAddr.parse(self.host).is_group
        if self.kind is DestinationKind.NET_ID:
            return False
        address = IPv4Address(self.host)
        return address.is_multicast or address == IPv4Address("255.255.255.255")

    def __str__(self) -> str:
        scheme = "tcp://" if self.kind is DestinationKind.TCP else ""
        port = f":{self.port}" if self.port else ""
        return f"{scheme}{self.host}{port}"


def _split_port(text: str) -> tuple[str, int]:
    host, separator, port = text.partition(":")
    try:
        address = str(IPv4Address(host))
    except ValueError:
        raise ValueError(f"{host!r} is not an IPv4 address") from None
    if not separator:
        return address, 0
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"{port!r} is not a port (1 to 65535)")
    return address, int(port)


_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")
_MAX_HOST_NAME = 253


def parse_host(text: str, usual_port: int) -> tuple[str, int]:
    """Return host and port of ``HOST[:PORT]``; raise ValueError if it is none.

    Whether the name of a host is known is seen when it is needed.
    """
    host, separator, number = text.partition(":")
    if separator and not (number.isdecimal() and 0 < int(number) < 65536):
        raise ValueError(f"{number!r} is not a port (1 to 65535)")
    labels = host.rstrip(".").split(".")
    if all(each.isdecimal() for each in labels):
        if not is_host(host):
            raise ValueError(f"{host!r} is not the IPv4 address of a host")
    elif len(host) > _MAX_HOST_NAME or not all(map(_LABEL.fullmatch, labels)):
        raise ValueError(f"{host!r} is no name of a host")
    return host, int(number) if separator else usual_port


def is_host(text: str) -> bool:
    """Return whether *text* is an IPv4 address that a single host can have."""
    try:
        address = IPv4Address(text)
    except ValueError:
        return False
    return not (address.is_multicast or address.is_unspecified or text == "255.255.255.255")


class Endpoint(NamedTuple):
    """Connection of a transport, or an address on a transport without connections.

    Two connections never have the same name while a process runs, even from one address; where
    there are none, *connection* is the sender's address, which answers go back to.
    """

    transport: str
    connection: str

    @property
    def kind(self) -> str:
        """Kind of the transport, a :class:`~eap.ams.spec.TransportKind`."""
        return self.transport.partition(":")[0]

    def __str__(self) -> str:
        # A transport to a single address is named after it: print the address once.
        return f"{self.connection} by {self.transport.removesuffix(f':{self.connection}')}"


@lru_cache(4096)
def endpoint_of(transport: str, connection: str) -> Endpoint:
    """Return an endpoint, the same object as before for each of the latest ones."""
    return Endpoint(transport, connection)
