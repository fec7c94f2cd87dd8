"""Object dictionary of a device description: Profile/Dictionary with its data types."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from devicebus.esi.fields import Fields, english
from devicebus.esi.records import EsiObject, EsiValue
from eap.codec import datatypes
from eap.codec.xmlstream import XmlElement, parse_integer
from eap.od.model import RO, RW, RW_PREOP, WO, Access

_ACCESS = {"ro": RO, "wo": WO, "rw": RW}
_MAX_SUBINDEX = 0xFF
_MAX_BITS = 8 * 0xFFFF
_MAX_BASES = 16


class _SubItem(NamedTuple):
    """Subindex of a data type (element SubItem)."""

    subindex: int
    name: str
    type: str
    access: Access


def type_of(name: str, bits: int) -> str:
    """Return the type *name* if it has *bits* bits, otherwise a type that holds them."""
    # The length goes before the name: it is what a PDO mapping and an SDO carry.
    try:
        kind = datatypes.parse(name)
    except ValueError:
        kind = None
    if kind is not None and kind.bit_length == bits:
        return name
    if number := datatypes.untyped(bits):
        return number
    if bits % 8 == 0:
        return f"BLOCK({bits // 8})"
    wider = next((size for size in (16, 32, 64) if size > bits), 0)
    return datatypes.untyped(wider) or f"BLOCK({bits // 8 + 1})"


def read_objects(parent: XmlElement, fields: Fields) -> tuple[EsiObject, ...]:
    """Return the objects below *parent*, a device or a module.

    Objects without a size, or of a type that the file does not have, are left out.
    """
    dictionary = parent.find("Profile/Dictionary")
    if dictionary is None:
        return ()
    types_node, objects_node = dictionary.find("DataTypes"), dictionary.find("Objects")
    types: dict[str, XmlElement] = {}
    for each in () if types_node is None else types_node.iterfind("DataType"):
        types[each.findtext("Name")] = each
    reader = _DictionaryReader(types, fields)
    found = () if objects_node is None else objects_node.iterfind("Object")
    # An index that a file has twice counts once: the last one.
    return tuple({item.index: item for each in found if (item := reader.object(each))}.values())


class _DictionaryReader:
    def __init__(self, types: Mapping[str, XmlElement], fields: Fields) -> None:
        self._types = types
        self._fields = fields
        self._parts: dict[str, tuple[_SubItem, ...]] = {}

    def object(self, item: XmlElement) -> EsiObject | None:
        """Return one object, None if it cannot be used."""
        fields = self._fields
        index = fields.child(item, "Index", bits=16)
        bits = fields.child(item, "BitSize")
        if not bits or bits > _MAX_BITS:
            return None
        kind = item.findtext("Type")
        name = english(item) or f"0x{index:04X}"
        if kind not in self._parts:
            self._parts[kind] = tuple(self._sub_items(self._types.get(kind)))
        if parts := self._parts[kind]:
            return EsiObject(
                index=index, name=name, entries=tuple(self._entries(item, parts)), is_record=True
            )
        if kind not in self._types and kind.startswith("DT"):
            return None
        simple = type_of(self._base(kind), bits)
        entry = EsiValue(
            subindex=0,
            name=name,
            type=simple,
            access=_access(item),
            default=self._default(item.find("Info"), simple),
        )
        return EsiObject(index=index, name=name, entries=(entry,))

    def _sub_items(self, kind: XmlElement | None) -> Iterator[_SubItem]:
        """Yield the subindexes of a data type from 1 on."""
        for item in () if kind is None else kind.iterfind("SubItem"):
            name = item.findtext("Type")
            bits = self._fields.child(item, "BitSize")
            access = _access(item)
            # A SubItem without SubIdx is an array: its elements are the subindexes.
            if item.find("SubIdx") is None:
                yield from self._elements(self._types.get(name), access)
                continue
            subindex = self._fields.child(item, "SubIdx")
            # Subindex 0 of a record is the number of its entries, which follows from the others.
            if 0 < subindex <= _MAX_SUBINDEX and 0 < bits <= _MAX_BITS:
                label = english(item) or f"SubIndex {subindex:03}"
                yield _SubItem(subindex, label, type_of(self._base(name), bits), access)

    def _elements(self, array: XmlElement | None, access: Access) -> Iterator[_SubItem]:
        """Yield the elements of an array."""
        if array is None:
            return
        count = self._fields.child(array, "ArrayInfo/Elements")
        first = self._fields.child(array, "ArrayInfo/LBound", default=1)
        bits = self._fields.child(array, "BitSize") // count if count else 0
        if not 0 < bits <= _MAX_BITS:
            return
        kind = type_of(self._base(array.findtext("BaseType")), bits)
        for subindex in range(max(first, 1), min(first + count, _MAX_SUBINDEX + 1)):
            yield _SubItem(subindex, f"SubIndex {subindex:03}", kind, access)

    def _entries(self, item: XmlElement, parts: tuple[_SubItem, ...]) -> Iterator[EsiValue]:
        # Initial values have the names of subindexes, not their numbers, and some may be missing.
        info = item.find("Info")
        infos: dict[str, XmlElement | None] = {}
        for each in () if info is None else info.iterfind("SubItem"):
            infos[each.findtext("Name")] = each.find("Info")
        # A subindex that a file has twice counts once: the last one.
        for part in {each.subindex: each for each in parts}.values():
            yield EsiValue(
                subindex=part.subindex,
                name=part.name,
                type=part.type,
                access=part.access,
                default=self._default(infos.get(part.name), part.type),
            )

    def _base(self, name: str) -> str:
        """Return the base type of a type that the file defines, such as an enumeration."""
        # Types that refer to each other in a circle end, too.
        for _ in range(_MAX_BASES):
            found = self._types.get(name)
            base = "" if found is None else found.findtext("BaseType")
            if not base or base == name:
                break
            name = base
        return name

    def _default(self, info: XmlElement | None, kind_name: str) -> bytes | None:
        """Return the encoded initial value; None without one that fits its type."""
        if info is None:
            return None
        kind = datatypes.parse(kind_name)
        try:
            if (data := info.findtext("DefaultData")) != "":
                octets = bytes.fromhex("".join(data.split())).ljust(kind.size, b"\0")
                return kind.encode(kind.decode(octets, 0))
            if (text := info.findtext("DefaultString")) != "":
                return kind.encode(text)
            if (text := info.findtext("DefaultValue")) != "":
                return kind.encode(parse_integer(text))
        except ValueError:
            return None
        return None


def _access(item: XmlElement) -> Access:
    flags = item.find("Flags/Access")
    if flags is None:
        return RW
    access = _ACCESS.get(flags.text.lower(), RW)
    # ETG.2000 has further restrictions, but known files have this one only.
    is_restricted = flags.get("WriteRestrictions").lower() == "preop"
    return RW_PREOP if access == RW and is_restricted else access
