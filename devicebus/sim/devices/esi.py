"""A device from its vendor's description: an ESI file (ETG.2000).

Read are identity, mailbox, PDOs and the object dictionary.  Addresses of sync managers are not: the
simulated controller has its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import msgspec
from defusedxml import ElementTree

from devicebus.sim.devices.esidictionary import number, objects, text_at, type_of
from devicebus.sim.spec import ChannelSpec, MailboxSpec, SlaveSpec

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_MAX_ENTRY_BITS = 255
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
    """Yield what the PDOs map; those without a sync manager are there to be assigned."""
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
