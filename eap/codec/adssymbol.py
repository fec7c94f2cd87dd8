"""ADS symbols and data types: entries of variables and of their types.

AdsSymbolEntry and its kin of AdsDef.h; AdsDatatypeEntry and AdsDatatypeArrayInfo of Beckhoff's
TcAdsDef.h, as the open client ads-client reads them.  Structures, methods and attributes of data
types do not occur here.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import NamedTuple

from eap.codec.wire import Buffer, WireStruct, u16, u32
from eap.errors import MalformedError, TruncatedError

CODE_PAGE = 1252
_ENCODING = f"cp{CODE_PAGE}"
"""TwinCAT's, for names, types and comments."""
# Clients accept 256 bytes with the NUL.
MAX_TEXT = 255
"""Bytes of a name, type or comment."""


class AdsType(IntEnum):
    """ADSDATATYPEID: how the bytes of a value are meant."""

    VOID = 0
    INT16 = 2
    INT32 = 3
    REAL32 = 4
    REAL64 = 5
    INT8 = 16
    UINT8 = 17
    UINT16 = 18
    UINT32 = 19
    INT64 = 20
    UINT64 = 21
    STRING = 30
    WSTRING = 31
    REAL80 = 32
    BIT = 33
    BIG = 65


class SymbolFlag(IntFlag):
    """ADSSYMBOLFLAG."""

    PERSISTENT = 0x0001
    BIT_VALUE = 0x0002
    READ_ONLY = 0x0020
    ATTRIBUTES = 0x1000


class SymbolAddress(WireStruct, frozen=True):
    """AdsSymbolInfoByName: where a value is; *size* in bytes."""

    group: u32
    offset: u32
    size: u32


class UploadInfo(WireStruct, frozen=True):
    """Answer to SYM_UPLOADINFO2; the first two fields are SYM_UPLOADINFO.  Sizes in bytes.

    Clients that know of its third version ask for 64 bytes: there *invalid_dynamic*,
    *code_page* of names and comments, *upload_flags* and seven reserved numbers follow, as the
    open client ads-client reads them.
    """

    symbols: u32
    symbol_size: u32
    types: u32 = 0
    type_size: u32 = 0
    max_dynamic: u32 = 0
    used_dynamic: u32 = 0

    def encode_for(self, length: int) -> bytes:
        """Return the newest version that fits into *length* bytes."""
        octets = self.encode()
        # Clients tell the version that they know by the length that they read.
        if length >= _INFO_3_SIZE:
            return (octets + _InfoTail(0, CODE_PAGE).encode()).ljust(_INFO_3_SIZE, b"\0")
        return octets[:length]


class _InfoTail(WireStruct, frozen=True):
    invalid_dynamic: u32
    code_page: u32
    upload_flags: u32 = 0


_INFO_3_SIZE = 64


class _SymbolHead(WireStruct, frozen=True):
    """AdsSymbolEntry; lengths of texts without their NUL."""

    entry_length: u32
    group: u32
    offset: u32
    size: u32
    type: u32
    flags: u32
    name_length: u16
    type_length: u16
    comment_length: u16


class HandleInfo(WireStruct, frozen=True):
    """Head in front of the type's name where a client accepts more than a handle.

    As the open client ads-client reads it; *decoration* is not documented.
    """

    handle: u32
    size: u32
    decoration: u32
    type_length: u16


class SymbolEntry(NamedTuple):
    """One variable as a server describes it."""

    address: SymbolAddress
    type: int
    """An AdsType; kept as a number if it is none."""
    flags: int
    name: str
    type_name: str
    comment: str = ""
    attributes: tuple[tuple[str, str], ...] = ()
    """Names and values."""


def encode_entry(entry: SymbolEntry) -> bytes:
    """Return an entry with its texts, each cut to MAX_TEXT bytes and ended by a NUL."""
    texts = [encode_text(text) for text in (entry.name, entry.type_name, entry.comment)]
    lengths = [len(text) for text in texts]
    address = entry.address
    attributes = _encode_attributes(entry.attributes)
    head = _SymbolHead(
        _SymbolHead.SIZE + sum(lengths) + len(texts) + len(attributes),
        address.group,
        address.offset,
        address.size,
        entry.type,
        entry.flags | (SymbolFlag.ATTRIBUTES if attributes else 0),
        *lengths,
    )
    return head.encode() + b"".join(text + b"\0" for text in texts) + attributes


def _encode_attributes(attributes: tuple[tuple[str, str], ...]) -> bytes:
    """Return the part behind the texts, as the open client ads-client reads it."""
    if not attributes:
        return b""
    octets = bytearray(len(attributes).to_bytes(2, "little"))
    for attribute in attributes:
        name, value = map(encode_text, attribute)
        octets += bytes((len(name), len(value))) + name + b"\0" + value + b"\0"
    return bytes(octets)


def decode_entry(data: Buffer, offset: int = 0) -> tuple[SymbolEntry, int]:
    """Return the entry at *offset* without its attributes, and where the next one begins.

    Raises:
        TruncatedError: the data ends before the entry does.
        MalformedError: its texts do not fit in it.
    """
    head = _SymbolHead.decode(data, offset)
    end = offset + head.entry_length
    lengths = (head.name_length, head.type_length, head.comment_length)
    if head.entry_length < _SymbolHead.SIZE + sum(lengths) + len(lengths):
        raise MalformedError(
            f"{head.entry_length} bytes do not hold texts of {lengths}",
            layout="AdsSymbolEntry",
            offset=offset,
        )
    if end > len(data):
        raise TruncatedError(
            f"{head.entry_length} bytes, but {len(data) - offset} follow",
            layout="AdsSymbolEntry",
            offset=offset,
        )
    texts = []
    at = offset + _SymbolHead.SIZE
    for length in lengths:
        texts.append(bytes(data[at : at + length]).decode(_ENCODING, "replace"))
        at += length + 1
    address = SymbolAddress(head.group, head.offset, head.size)
    name, type_name, comment = texts
    return SymbolEntry(address, head.type, head.flags, name, type_name, comment), end


def encode_text(text: str) -> bytes:
    """Return a text in TwinCAT's encoding, without NUL."""
    return text.encode(_ENCODING, "replace").replace(b"\0", b"?")[:MAX_TEXT]


def decode_name(data: Buffer) -> str:
    """Return the name in a request: UTF-8 or TwinCAT's encoding, up to a NUL."""
    octets, _, _ = bytes(data).partition(b"\0")
    try:
        return octets.decode()
    except UnicodeDecodeError:
        return octets.decode(_ENCODING, "replace")


class DataTypeFlag(IntFlag):
    """ADSDATATYPEFLAG."""

    DATA_TYPE = 0x0001


class _DataTypeHead(WireStruct, frozen=True):
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
    """Bytes."""
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
    head = _DataTypeHead(
        entry_length=_DataTypeHead.SIZE + len(behind),
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
