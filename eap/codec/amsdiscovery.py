"""Datagrams of UDP port 48899, by which tools find AMS routers and add routes to them.

Beckhoff documents none of it.  The layout is that of the requests of pyads 3.6, AdsLib and ads-rs
(which has version and options), all open source; unknown tags are kept unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

from eap.codec.wire import Buffer, WireStruct, net_id, u16, u32
from eap.errors import CodecError, MalformedError, TruncatedError

AMS_UDP_PORT = 48899
COOKIE = 0x71146603
RESPONSE = 0x8000_0000
"""Bit of the service in answers."""


TEMPORARY = 1
"""Bit of the options: the route is gone after a new start."""


class DiscoveryService(IntEnum):
    """Requested service."""

    SERVER_INFO = 1
    ADD_ROUTE = 6


class Tag(IntEnum):
    """Content of a tag."""

    RESULT = 1
    """32 bits, as in ADS."""
    PASSWORD = 2
    VERSION = 3
    """Of the router: two bytes and 16 bits."""
    HOST = 5
    NET_ID = 7
    OPTIONS = 9
    """32 bits."""
    ROUTE_NAME = 12
    USER = 13


class DiscoveryHeader(WireStruct, frozen=True):
    """Header of each datagram.

    *service* and *invoke_id* stay numbers; *net_id* and *port* are those of the sender's router.
    *count* is the number of tags that follow.
    """

    cookie: u32
    invoke_id: u32
    service: u32
    net_id: net_id
    port: u16
    count: u32 = 0


class TagHeader(WireStruct, frozen=True):
    """Header of each tag; *length* bytes follow."""

    id: u16
    length: u16


class Discovery(NamedTuple):
    """A datagram."""

    header: DiscoveryHeader
    tags: tuple[tuple[int, bytes], ...] = ()

    def find(self, tag: int) -> bytes | None:
        """Return the data of the first *tag*, None without."""
        return next((data for found, data in self.tags if found == tag), None)


def decode_discovery(data: Buffer) -> Discovery:
    """Read a datagram; surplus bytes behind its tags are ignored.

    Raises:
        TruncatedError: there are fewer tags than it says, or one is cut.
        MalformedError: it does not begin with the cookie.
    """
    header = DiscoveryHeader.decode(data)
    if header.cookie != COOKIE:
        raise MalformedError(
            f"cookie is 0x{header.cookie:08x}, expected 0x{COOKIE:08x}", layout="DiscoveryHeader"
        )
    tags, at = [], DiscoveryHeader.SIZE
    for _ in range(header.count):  # each takes bytes, so there are never more than those allow
        tag = TagHeader.decode(data, at)
        at += TagHeader.SIZE
        # A tag that is cut off would be read as a shorter password or name.
        if len(data) - at < tag.length:
            raise TruncatedError(
                f"length {tag.length}, but {len(data) - at} bytes follow",
                layout="TagHeader",
                offset=at - TagHeader.SIZE,
            )
        tags.append((tag.id, bytes(data[at : at + tag.length])))
        at += tag.length
    return Discovery(header, tuple(tags))


def encode_discovery(header: DiscoveryHeader, tags: Iterable[tuple[int, bytes]] = ()) -> bytes:
    """Return a datagram; cookie and count are set.

    Raises CodecError if a tag is longer than 65535 bytes.
    """
    parts = [TagHeader(tag, len(data)).encode() + data for tag, data in tags]
    whole = DiscoveryHeader(
        COOKIE, header.invoke_id, header.service, header.net_id, header.port, len(parts)
    )
    return whole.encode() + b"".join(parts)


def decode_text(data: bytes) -> str:
    """Read the text of a tag: up to its NUL if it has one, undecodable bytes replaced."""
    return data.partition(b"\0")[0].decode(errors="replace")


def encode_text(text: str) -> bytes:
    """Return *text* as tags hold it: UTF-8 and a NUL that the length counts.

    Raises CodecError if there is a NUL in it.
    """
    if "\0" in text:
        raise CodecError(f"a NUL in {text!r}", layout="Tag")
    return text.encode() + b"\0"


def encode_version(text: str) -> bytes:
    """Return the tag that says ``MAJOR.MINOR.BUILD``; what is missing or no number is 0."""
    numbers = [*map(_number, text.split(".")), 0, 0, 0]
    return bytes((min(numbers[0], 0xFF), min(numbers[1], 0xFF))) + min(numbers[2], 0xFFFF).to_bytes(
        2, "little"
    )


def decode_version(data: bytes) -> str:
    """Read what :func:`encode_version` returns; empty if it is not four bytes."""
    if len(data) != 4:
        return ""
    return f"{data[0]}.{data[1]}.{int.from_bytes(data[2:], 'little')}"


def _number(text: str) -> int:
    return int(text) if text.isascii() and text.isdigit() else 0
