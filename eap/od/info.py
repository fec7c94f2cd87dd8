"""SDO information: a dictionary described to a client that knows nothing of it (ETG.1000.6).

The functions return the bodies of the answers, without CoE and SDO information headers; AoE carries
the same bodies.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Access, Entry, OdObject


class ListType(IntEnum):
    """Kind of a list of objects."""

    COUNTS = 0
    ALL = 1
    RX_MAPPABLE = 2
    TX_MAPPABLE = 3
    BACKUP = 4
    SETTINGS = 5


class ValueInfo(IntFlag):
    """Parts of an entry description."""

    ACCESS = 0x01
    CATEGORY = 0x02
    MAPPABLE = 0x04
    UNIT = 0x08
    DEFAULT = 0x10
    MINIMUM = 0x20
    MAXIMUM = 0x40


_FLAG = {
    ListType.RX_MAPPABLE: Access.RX_MAPPABLE,
    ListType.TX_MAPPABLE: Access.TX_MAPPABLE,
    ListType.BACKUP: Access.BACKUP,
    ListType.SETTINGS: Access.SETTINGS,
}


def object_list(dictionary: ObjectDictionary, list_type: int) -> bytes:
    """Return the list type and the indexes of its objects, or the counts of the five lists.

    Raises:
        SdoAbortError: there is no such list.
    """
    try:
        kind = ListType(list_type)
    except ValueError:
        raise SdoAbortError(
            AbortCode.PARAMETER, 0, 0, f"object list type {list_type}, expected 0 to 5"
        ) from None
    if kind is ListType.COUNTS:
        # List type 0: the counts of the five lists, in their order.
        numbers = [len(_indexes(dictionary, each)) for each in ListType if each]
    else:
        numbers = _indexes(dictionary, kind)
    return struct.pack(f"<H{len(numbers)}H", list_type, *numbers)


def object_description(dictionary: ObjectDictionary, index: int) -> bytes:
    """Return index, data type, highest subindex, object code and name."""
    item = dictionary[index]
    head = struct.pack("<HHBB", index, item.data_type, item.max_subindex, item.code)
    return head + item.name.encode()


def entry_description(
    dictionary: ObjectDictionary, index: int, subindex: int, value_info: int
) -> bytes:
    """Return type, length, rights, the existing parts of *value_info*, and the name."""
    entry = dictionary.entry(index, subindex)
    parts = {
        ValueInfo.UNIT: None if entry.unit is None else struct.pack("<I", entry.unit),
        ValueInfo.DEFAULT: entry.default,
        ValueInfo.MINIMUM: _limit(entry, entry.minimum),
        ValueInfo.MAXIMUM: _limit(entry, entry.maximum),
    }
    # pyetg1510 takes units, defaults and limits for the name: a master's dictionary gives none.
    wanted = value_info if dictionary.describes_values else 0
    given = {flag: octets for flag, octets in parts.items() if octets and wanted & flag}
    # Rights, category and mappability are in the fixed part, so they are always there.
    flags = value_info & 0x07
    for flag in given:
        flags |= flag
    head = struct.pack(
        "<HBBHHH",
        index,
        subindex,
        flags,
        entry.kind.code,
        entry.kind.bit_length,
        entry.access,
    )
    return head + b"".join(given.values()) + entry.name.encode()


def _indexes(dictionary: ObjectDictionary, kind: ListType) -> list[int]:
    flag = _FLAG.get(kind)
    return [item.index for item in dictionary if flag is None or _has(item, flag)]


def _has(item: OdObject, flag: Access) -> bool:
    return any(entry.access & flag for entry in item.entries.values())


def _limit(entry: Entry, limit: float | None) -> bytes | None:
    return None if limit is None else entry.kind.encode(limit)
