"""Import of a device from its vendor's ESI file (ETG.2000).

Identity, mailbox, PDOs and object dictionary are imported.  Addresses of sync managers are not: the
simulated controller has its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import msgspec
from defusedxml import ElementTree

from devicebus.sim.spec import (
    AccessKind,
    ChannelSpec,
    EntrySpec,
    MailboxSpec,
    ObjectSpec,
    SlaveSpec,
    Value,
)
from eap.codec import datatypes

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


_BY_BITS = {1: "BOOL", 8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"}
_ACCESS = {"ro": AccessKind.READ, "wo": AccessKind.WRITE, "rw": AccessKind.READ_WRITE}
_STANDARD = frozenset(
    (0x1000, 0x1001, 0x1008, 0x1009, 0x100A, 0x1018, 0x1C00, *range(0x1600, 0x1800),
     *range(0x1A00, 0x1C00), *range(0x1C10, 0x1C20))
)  # fmt: skip
_MAX_SUBINDEX = 0xFF


class _SubItem(NamedTuple):
    """Subindex of a data type (ESI element SubItem)."""

    subindex: int
    name: str
    kind: str
    bits: int
    access: AccessKind


def number(text: str) -> int:
    """Parse a number of an ESI file, ``#x1A00`` or ``6656``; raise ValueError otherwise."""
    stripped = text.strip().lower()
    digits = stripped.removeprefix("#x")
    return int(digits, 10 if digits == stripped else 16)


def text_at(element: Element, path: str, default: str) -> str:
    """Return the text at *path*, or *default*."""
    return (element.findtext(path) or default).strip()


def type_of(name: str, bits: int) -> str:
    """Return the type *name* if it has *bits* bits, otherwise a type that holds them."""
    try:
        kind = datatypes.parse(name)
    except ValueError:
        kind = None
    if kind is not None and kind.bit_length == bits:
        return name
    if bits in _BY_BITS:
        return _BY_BITS[bits]
    if bits < 8:
        return f"BIT{bits}"
    if bits % 8 == 0:
        return f"BLOCK({bits // 8})"
    whole = f"BLOCK({bits // 8 + 1})"
    return next((kind for size, kind in _BY_BITS.items() if size > bits), whole)


def objects(device: Element) -> Iterator[ObjectSpec]:
    """Yield the objects of a device description.

    Raises:
        ValueError: a number is invalid.
    """
    types = {
        text_at(each, "Name", ""): each
        for each in device.iterfind("Profile/Dictionary/DataTypes/DataType")
    }
    for item in device.iterfind("Profile/Dictionary/Objects/Object"):
        index = number(text_at(item, "Index", "0"))
        bits = number(text_at(item, "BitSize", "0"))
        # The standard objects are built from identity and PDOs of the file, so that both agree.
        if index in _STANDARD or not bits:
            continue
        kind = text_at(item, "Type", "")
        parts = list(_sub_items(types.get(kind), types))
        name = text_at(item, "Name", f"0x{index:04X}")
        if parts:
            yield ObjectSpec(index=index, name=name, entries=tuple(_entries(item, parts)))
        elif kind in types or not kind.startswith("DT"):
            simple = type_of(_base(kind, types), bits)
            value = _value(item.find("Info"), simple)
            yield ObjectSpec(index=index, name=name, type=simple, value=value, access=_access(item))


def _sub_items(kind: Element | None, types: dict[str, Element]) -> Iterator[_SubItem]:
    """Yield the subindexes of a data type from 1 on."""
    for item in () if kind is None else kind.iterfind("SubItem"):
        name = text_at(item, "Type", "")
        bits = number(text_at(item, "BitSize", "0"))
        access = _access(item)
        # A SubItem without SubIdx is an array: its elements are the subindexes.
        if item.find("SubIdx") is None:
            yield from _elements(types.get(name), types, access)
            continue
        subindex = number(text_at(item, "SubIdx", "0"))
        if 0 < subindex <= _MAX_SUBINDEX and bits:
            label = text_at(item, "Name", f"SubIndex {subindex:03}")
            yield _SubItem(subindex, label, type_of(_base(name, types), bits), bits, access)


def _elements(
    array: Element | None, types: dict[str, Element], access: AccessKind
) -> Iterator[_SubItem]:
    """Yield the elements of an array."""
    if array is None:
        return
    count = number(text_at(array, "ArrayInfo/Elements", "0"))
    first = number(text_at(array, "ArrayInfo/LBound", "1"))
    bits = number(text_at(array, "BitSize", "0")) // count if count else 0
    if not bits:
        return
    kind = type_of(_base(text_at(array, "BaseType", ""), types), bits)
    for subindex in range(max(first, 1), min(first + count, _MAX_SUBINDEX + 1)):
        yield _SubItem(subindex, f"SubIndex {subindex:03}", kind, bits, access)


def _entries(item: Element, parts: list[_SubItem]) -> Iterator[EntrySpec]:
    infos = {text_at(each, "Name", ""): each.find("Info") for each in item.iterfind("Info/SubItem")}
    # A subindex that a file has twice counts once: the last one.
    for part in {each.subindex: each for each in parts}.values():
        yield EntrySpec(
            subindex=part.subindex,
            name=part.name,
            type=part.kind,
            value=_value(infos.get(part.name), part.kind),
            access=part.access,
        )


def _base(name: str, types: dict[str, Element]) -> str:
    """Return the base type of a type that the file defines, such as an enumeration."""
    found = types.get(name)
    return name if found is None else text_at(found, "BaseType", name)


def _access(item: Element) -> AccessKind:
    flags = item.find("Flags/Access")
    if flags is None:
        return AccessKind.READ_WRITE
    access = _ACCESS.get((flags.text or "").strip().lower(), AccessKind.READ_WRITE)
    restricted = flags.get("WriteRestrictions", "").lower() == "preop"
    if access is AccessKind.READ_WRITE and restricted:
        return AccessKind.CONFIGURATION
    return access


def _value(info: Element | None, kind_name: str) -> Value | None:
    """Return the initial value of an entry; None without one that fits its type."""
    if info is None:
        return None
    kind = datatypes.parse(kind_name)
    try:
        if (data := text_at(info, "DefaultData", "")) != "":
            octets = bytes.fromhex(data).ljust(kind.size, b"\0")
            plain = kind.to_plain(kind.decode(octets, 0))
        elif (text := text_at(info, "DefaultString", "")) != "":
            plain = text
        elif (text := text_at(info, "DefaultValue", "")) != "":
            plain = number(text)
        else:
            return None
        kind.encode(plain)
    except ValueError:
        return None
    return None if isinstance(plain, list | dict) else plain


_MAX_ENTRY_BITS = 255
_MINIMUM_MAILBOX = 32


def complete(spec: SlaveSpec, xml: bytes) -> SlaveSpec:
    """Return *spec* completed by the file; the product code in *spec* selects the device.

    Raises:
        ValueError: the file is no ESI file, or does not describe the device.
    """
    root = _parse(xml, spec.esi)
    device = _choose(root, spec)
    kind = device.find("Type")
    attributes = {} if kind is None else kind.attrib
    own = {each.index for each in spec.objects}
    return msgspec.structs.replace(
        spec,
        vendor=number(text_at(root, "Vendor/Id", "0")),
        product=number(attributes.get("ProductCode", "0")),
        revision=number(attributes.get("RevisionNo", "0")),
        mailbox=_mailbox(device),
        inputs=spec.inputs or tuple(_channels(device.iterfind("TxPdo"))),
        outputs=spec.outputs or tuple(_channels(device.iterfind("RxPdo"))),
        objects=(*spec.objects, *(each for each in objects(device) if each.index not in own)),
    )


def _parse(xml: bytes, name: str) -> Element:
    try:
        root: Element = ElementTree.fromstring(xml)
    except (SyntaxError, ValueError) as exc:
        raise ValueError(f"{name} is not XML that can be read: {exc}") from None
    if root.tag != "EtherCATInfo":
        raise ValueError(f"{name} begins with {root.tag}, expected EtherCATInfo")
    return root


def _choose(root: Element, spec: SlaveSpec) -> Element:
    devices = list(root.iterfind("Descriptions/Devices/Device"))
    for device in devices:
        kind = device.find("Type")
        code = "0" if kind is None else kind.get("ProductCode", "0")
        if not spec.product or number(code) == spec.product:
            return device
    raise ValueError(
        f"{spec.esi} describes {len(devices)} devices, none with product code {spec.product:#x}"
    )


def _mailbox(device: Element) -> MailboxSpec | None:
    mailbox = device.find("Mailbox")
    if mailbox is None:
        return None
    # The first two sync managers are the mailboxes.
    sizes = [number(each.get("DefaultSize", "128")) for each in device.findall("Sm")[:2]]
    return MailboxSpec(
        size=max(_MINIMUM_MAILBOX, min(sizes, default=128)),
        coe=mailbox.find("CoE") is not None,
        foe=mailbox.find("FoE") is not None,
        soe=mailbox.find("SoE") is not None,
        eoe=mailbox.find("EoE") is not None,
        voe=mailbox.find("VoE") is not None,
        aoe=mailbox.find("AoE") is not None,
    )


def _channels(pdos: Iterable[Element]) -> Iterator[ChannelSpec]:
    """Yield the mapped entries of all PDOs; PDOs without a sync manager can be assigned."""
    for pdo in pdos:
        index = number(text_at(pdo, "Index", "0"))
        assigned = "Sm" in pdo.attrib
        for entry in pdo.iterfind("Entry"):
            bits = number(text_at(entry, "BitLen", "0"))
            place = number(text_at(entry, "Index", "0"))
            if not place:
                yield from _padding(bits, index, assigned=assigned)
            elif bits:
                name = f"{place:#06x}:{number(text_at(entry, 'SubIndex', '0'))}"
                yield ChannelSpec(
                    name=text_at(entry, "Name", name),
                    type=type_of(text_at(entry, "DataType", ""), bits),
                    object=name,
                    bits=bits,
                    pdo=index,
                    assigned=assigned,
                )


def _padding(bits: int, pdo: int, *, assigned: bool) -> Iterator[ChannelSpec]:
    while bits:
        part = min(bits, _MAX_ENTRY_BITS)
        yield ChannelSpec(name="", object="0", bits=part, pdo=pdo, assigned=assigned)
        bits -= part
