"""A device from its vendor's description: an ESI file (ETG.2000).

Read are identity, name, mailbox, PDO entries and the variables of the dictionary.  All RxPDOs and
all TxPDOs that are on by default become one PDO each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import msgspec
from defusedxml import ElementTree

from devicebus.sim.spec import AccessKind, ChannelSpec, MailboxSpec, ObjectSpec, SlaveSpec
from eap.codec import datatypes

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_BY_BITS = {1: "BOOL", 8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"}
_ACCESS = {"ro": AccessKind.READ, "wo": AccessKind.WRITE, "rw": AccessKind.READ_WRITE}
_STANDARD = frozenset(
    (0x1000, 0x1001, 0x1008, 0x1009, 0x100A, 0x1018, 0x1C00, *range(0x1600, 0x1700),
     *range(0x1A00, 0x1B00), *range(0x1C10, 0x1C20))
)  # fmt: skip
_MINIMUM_MAILBOX = 32


def complete(spec: SlaveSpec, xml: bytes) -> SlaveSpec:
    """Return *spec* with what the file says; the product code in *spec* chooses among devices.

    Raises:
        ValueError: the file is no ESI file, or describes no such device.
    """
    root = _parse(xml, spec.esi)
    device = _choose(root, spec)
    kind = device.find("Type")
    attributes = {} if kind is None else kind.attrib
    own = {each.index for each in spec.objects}
    return msgspec.structs.replace(
        spec,
        vendor=number(_text(root, "Vendor/Id", "0")),
        product=number(attributes.get("ProductCode", "0")),
        revision=number(attributes.get("RevisionNo", "0")),
        mailbox=_mailbox(device),
        inputs=spec.inputs or tuple(_channels(device.iterfind("TxPdo"))),
        outputs=spec.outputs or tuple(_channels(device.iterfind("RxPdo"))),
        objects=(*spec.objects, *(each for each in _objects(device) if each.index not in own)),
    )


def number(text: str) -> int:
    """Read ``#x1A00`` or ``6656``, as ESI files write numbers; raise ValueError otherwise."""
    stripped = text.strip().lower()
    digits = stripped.removeprefix("#x")
    return int(digits, 10 if digits == stripped else 16)


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
    for pdo in pdos:
        if "Sm" not in pdo.attrib:
            continue
        for entry in pdo.iterfind("Entry"):
            index = number(_text(entry, "Index", "0"))
            bits = number(_text(entry, "BitLen", "0"))
            if index and bits:
                place = f"{index:#06x}:{number(_text(entry, 'SubIndex', '0'))}"
                yield ChannelSpec(
                    name=_text(entry, "Name", place),
                    type=_type(_text(entry, "DataType", ""), bits),
                    object=place,
                )


def _objects(device: Element) -> Iterator[ObjectSpec]:
    for item in device.iterfind("Profile/Dictionary/Objects/Object"):
        index = number(_text(item, "Index", "0"))
        name, bits = _text(item, "Type", ""), number(_text(item, "BitSize", "0"))
        if index in _STANDARD or not bits or not _is_simple(name):
            continue
        yield ObjectSpec(
            index=index,
            name=_text(item, "Name", f"0x{index:04X}"),
            type=_type(name, bits),
            access=_ACCESS.get(_text(item, "Flags/Access", "rw"), AccessKind.READ_WRITE),
        )


def _is_simple(name: str) -> bool:
    # DT… are the records that the file itself defines.
    return bool(name) and not name.startswith("DT")


def _type(name: str, bits: int) -> str:
    try:
        kind = datatypes.parse(name)
    except ValueError:
        kind = None
    if kind is not None and kind.bit_length == bits:
        return name
    if bits in _BY_BITS:
        return _BY_BITS[bits]
    return f"BIT{bits}" if bits < 8 else f"BLOCK({(bits + 7) // 8})"


def _text(element: Element, path: str, default: str) -> str:
    return (element.findtext(path) or default).strip()
