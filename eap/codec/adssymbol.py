"""ADS symbols and data types: entries of variables and of their types.

AdsSymbolEntry and its kin of AdsDef.h; AdsDatatypeEntry and AdsDatatypeArrayInfo of Beckhoff's
TcAdsDef.h, as the open client ads-client reads them.  Methods, copy masks and the lists of newer
releases do not occur here.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Annotated, NamedTuple

from eap.codec.wire import Buffer, Scalar, WireStruct, u16, u32

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
    TYPE_GUID = 0x0008
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


class ArrayDimension(WireStruct, frozen=True):
    """AdsDatatypeArrayInfo: one dimension of an array."""

    lower_bound: Annotated[int, Scalar("i")]
    elements: u32


class _SymbolHead(WireStruct, frozen=True):
    """AdsSymbolEntry; lengths of texts without their NUL."""

    entry_length: u32
    group: u32
    offset: u32
    size: u32
    type: u32
    flags: u16
    dimensions: u16
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
    """One variable, or a part of one, as a server describes it."""

    address: SymbolAddress
    type: int
    """An AdsType; kept as a number if it is none."""
    flags: int
    name: str
    type_name: str
    comment: str = ""
    dimensions: tuple[ArrayDimension, ...] = ()
    """Of an array."""
    guid: bytes = b""
    """GUID of the type, 16 bytes; empty if none is known."""
    attributes: tuple[tuple[str, str], ...] = ()
    """Names and values."""


def encode_entry(entry: SymbolEntry) -> bytes:
    """Return an entry with its texts, each cut to MAX_TEXT bytes and ended by a NUL."""
    texts = [encode_text(text) for text in (entry.name, entry.type_name, entry.comment)]
    flags = entry.flags
    if entry.guid:
        # The flags tell clients what stands behind the texts.
        flags |= SymbolFlag.TYPE_GUID
    if entry.attributes:
        flags |= SymbolFlag.ATTRIBUTES
    parts = [text + b"\0" for text in texts]
    parts += [each.encode() for each in entry.dimensions]
    parts += [entry.guid, _encode_attributes(entry.attributes)]
    behind = b"".join(parts)
    address = entry.address
    head = _SymbolHead(
        _SymbolHead.SIZE + len(behind),
        address.group,
        address.offset,
        address.size,
        entry.type,
        flags,
        len(entry.dimensions),
        *map(len, texts),
    )
    return head.encode() + behind


def _encode_attributes(attributes: tuple[tuple[str, str], ...]) -> bytes:
    """Return names and values behind their number, as the open client ads-client reads them."""
    if not attributes:
        return b""
    octets = bytearray(len(attributes).to_bytes(2, "little"))
    for attribute in attributes:
        name, value = map(encode_text, attribute)
        octets += bytes((len(name), len(value))) + name + b"\0" + value + b"\0"
    return bytes(octets)


def encode_text(text: str) -> bytes:
    """Return a text in TwinCAT's encoding, without NUL."""
    return text.encode(_ENCODING, "replace").replace(b"\0", b"?")[:MAX_TEXT]


def decode_name(data: Buffer) -> str:
    """Return the name in a request: UTF-8 or TwinCAT's encoding, up to a NUL."""
    octets, _, _ = bytes(data).partition(b"\0")
    # UTF-8 first: a text of cp1252 with more than ASCII is hardly ever valid UTF-8.
    try:
        return octets.decode()
    except UnicodeDecodeError:
        return octets.decode(_ENCODING, "replace")


class DataTypeFlag(IntFlag):
    """ADSDATATYPEFLAG."""

    DATA_TYPE = 0x0001
    DATA_ITEM = 0x0002
    BIT_VALUES = 0x0020
    """Size and offset are numbers of bits."""
    TYPE_GUID = 0x0080
    ATTRIBUTES = 0x1000
    ENUM_INFOS = 0x2000


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


class DataTypeEntry(NamedTuple):
    """A type, or with DATA_ITEM a member of one."""

    name: str
    """Of a member its own name."""
    type: int
    """An AdsType."""
    size: int
    """Bytes, or bits with BIT_VALUES."""
    type_name: str = ""
    """Type of a member, of an array's elements, or that an alias or enumeration is based on."""
    comment: str = ""
    flags: int = DataTypeFlag.DATA_TYPE
    """Without those that follow from the fields below."""
    offset: int = 0
    """Of a member, in the unit of the size."""
    hash: int = 0
    """Changes with the type."""
    type_hash: int = 0
    """Hash of the type called *type_name*."""
    dimensions: tuple[ArrayDimension, ...] = ()
    items: tuple[DataTypeEntry, ...] = ()
    """Members of a struct."""
    guid: bytes = b""
    """16 bytes; empty if none is known."""
    attributes: tuple[tuple[str, str], ...] = ()
    values: tuple[tuple[str, int], ...] = ()
    """Names and numbers of an enumeration."""


def encode_data_type(entry: DataTypeEntry) -> bytes:
    """Return an entry with its texts, dimensions and members, whose entries have the same form."""
    texts = [encode_text(text) for text in (entry.name, entry.type_name, entry.comment)]
    flags = entry.flags
    if entry.guid:
        flags |= DataTypeFlag.TYPE_GUID
    if entry.attributes:
        flags |= DataTypeFlag.ATTRIBUTES
    if entry.values:
        flags |= DataTypeFlag.ENUM_INFOS
    parts = [text + b"\0" for text in texts]
    parts += [each.encode() for each in entry.dimensions]
    parts += [encode_data_type(item) for item in entry.items]
    # Behind the members, in the order of their flags.
    parts += [entry.guid, _encode_attributes(entry.attributes), _encode_values(entry)]
    behind = b"".join(parts)
    head = _DataTypeHead(
        entry_length=_DataTypeHead.SIZE + len(behind),
        version=1,
        hash=entry.hash,
        type_hash=entry.type_hash,
        size=entry.size,
        offset=entry.offset,
        type=entry.type,
        flags=flags,
        name_length=len(texts[0]),
        type_length=len(texts[1]),
        comment_length=len(texts[2]),
        dimensions=len(entry.dimensions),
        items=len(entry.items),
    )
    return head.encode() + behind


def _encode_values(entry: DataTypeEntry) -> bytes:
    if not entry.values:
        return b""
    octets = bytearray(len(entry.values).to_bytes(2, "little"))
    for text, number in entry.values:
        name = encode_text(text)
        octets += bytes((len(name),)) + name + b"\0"
        octets += (number & (1 << 8 * entry.size) - 1).to_bytes(entry.size, "little")
    return bytes(octets)
