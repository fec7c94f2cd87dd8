"""ADS data types: how a server tells what the types of its symbols are made of.

AdsDatatypeEntry and AdsDatatypeArrayInfo of Beckhoff's TcAdsDef.h, as the open client ads-client
reads them; of structures, methods and attributes nothing here has any.
"""

from __future__ import annotations

from enum import IntFlag
from typing import NamedTuple

from eap.codec.adssymbol import encode_text
from eap.codec.wire import WireStruct, u16, u32


class DataTypeFlag(IntFlag):
    """ADSDATATYPEFLAG."""

    DATA_TYPE = 0x0001


class _EntryHead(WireStruct, frozen=True):
    """Lengths of texts without their NUL."""

    entry_length: u32
    version: u32
    hash: u32
    type_hash: u32
    size: u32
    offset: u32
    type: u32
    flags: u32
    name_length: u16
    type_length: u16
    comment_length: u16
    dimensions: u16
    items: u16


class _Dimension(WireStruct, frozen=True):
    lower_bound: u32
    elements: u32


class DataTypeEntry(NamedTuple):
    """A number, a text, or a list of one dimension that begins with element 0."""

    name: str
    type: int
    """Id of the type, or of the elements."""
    size: int
    """Octets."""
    element: str = ""
    """Name of the elements' type; empty if it is no list."""
    elements: int = 0
    """Of a list."""


def encode_data_type(entry: DataTypeEntry) -> bytes:
    """Return an entry with its texts and its dimension, if it has one."""
    name, element = encode_text(entry.name), encode_text(entry.element)
    behind = name + b"\0" + element + b"\0\0"
    if entry.elements:
        behind += _Dimension(0, entry.elements).encode()
    head = _EntryHead(
        entry_length=_EntryHead.SIZE + len(behind),
        version=1,
        hash=0,
        type_hash=0,
        size=entry.size,
        offset=0,
        type=entry.type,
        flags=DataTypeFlag.DATA_TYPE,
        name_length=len(name),
        type_length=len(element),
        comment_length=0,
        dimensions=1 if entry.elements else 0,
        items=0,
    )
    return head.encode() + behind
