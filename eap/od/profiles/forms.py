"""Forms of a profile's entries: texts for people, and rules for content."""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import StrEnum
from ipaddress import IPv4Address

from eap.codec.datatypes import DataType
from eap.ids import MacAddr, NetId, ObjectId


class Rule(StrEnum):
    """Rules for the content of an entry, beyond its type and limits."""

    NONE = ""
    NAME = "name"
    """A name of a station's parts: no spaces, no slashes."""
    TYPE = "type"
    """A data type."""
    DEFAULT = "default"
    """A value of the variable's type; numbers are finite."""
    FLAGS = "flags"
    """Known flags of an RxPD."""
    GROUP = "group"
    """A multicast address, MAC or IPv4, or empty."""
    SOURCE = "source"
    """A MAC or IPv4 address, or empty."""
    STATE = "state"
    """A state that can be requested."""


class Form(StrEnum):
    """What an entry is to people, beside its data type."""

    PLAIN = "plain"
    """As its type is written."""
    HEX = "hex"
    INDEX = "index"
    """Of another object; 0 is none."""
    MAPPING = "mapping"
    """Entry and bit length, as ``0x6000:01/16``."""
    MAC = "mac"
    NET_ID = "net_id"
    IP = "ip"

    @property
    def is_address(self) -> bool:
        """Whether it is a block of octets that has a text of its own."""
        return self in _BLOCKS

    def text_of(self, octets: bytes) -> str:
        """Return an address as people write it."""
        return _BLOCKS[self][0](octets)

    def octets_of(self, text: str) -> bytes:
        """Return the octets of an address; raise ValueError if *text* is none."""
        return _BLOCKS[self][1](text)


def to_text(form: Form, kind: DataType, octets: bytes) -> str:
    """Return the *octets* of an entry as people write them; :func:`from_text` reads it again."""
    if form.is_address:
        return form.text_of(octets)
    value = kind.decode(octets.ljust(kind.size, b"\0"), 0)
    if form is Form.MAPPING and isinstance(value, int):
        return f"{ObjectId(value >> 16, value >> 8 & 0xFF)}/{value & 0xFF}"
    if form in {Form.HEX, Form.INDEX} and isinstance(value, int):
        return f"0x{value:0{2 * kind.size}X}"
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, tuple):
        return ", ".join(str(number) for number in value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def from_text(form: Form, kind: DataType, text: str) -> bytes:
    """Return the octets that *text* stands for.

    Raises:
        ValueError: it is nothing of the form, or no value of the type.
    """
    if form.is_address:
        return form.octets_of(text)
    if form is Form.MAPPING and "/" in text:
        entry, _, bits = text.strip().partition("/")
        if ":" not in entry or not _BITS.fullmatch(bits):
            raise ValueError(f"{text!r} is no mapping such as 0x6000:01/16")
        index, subindex = ObjectId.parse(entry)
        return kind.encode(index << 16 | subindex << 8 | int(bits))
    octets = kind.encode(kind.parse_text(text))
    return octets.rstrip(b"\0") if kind.is_text else octets


_BITS = re.compile(r"\d{1,2}|1\d\d|2[0-4]\d|25[0-5]", re.ASCII)
_BLOCKS: dict[Form, tuple[Callable[[bytes], str], Callable[[str], bytes]]] = {
    Form.MAC: (lambda octets: str(MacAddr(octets)), lambda text: bytes(MacAddr.parse(text))),
    Form.NET_ID: (lambda octets: str(NetId(octets)), lambda text: bytes(NetId.parse(text))),
    Form.IP: (lambda octets: str(IPv4Address(octets)), lambda text: IPv4Address(text).packed),
}
