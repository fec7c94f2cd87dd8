"""Automation Interface XML of TwinCAT: descriptions of tree items, read and written.

TwinCAT exports and imports one item at a time (ProduceXml, ConsumeXml, "Export XML Description").
Element names are those of Beckhoff's samples; there is no public schema.  A file may have one item,
items within items, or several below ``TreeItems``, which is this project's own form.  Settings for
which no element is known are attributes of elements in a namespace of this project; TwinCAT ignores
what it does not know.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from ipaddress import IPv4Address
from typing import TypeVar
from xml.sax.saxutils import escape, quoteattr

import msgspec

from eap.codec.xmlstream import XmlElement, XmlError, read_tree
from eap.config.imports.records import (
    ARP_MS,
    DATA,
    EAP_DEVICE,
    ITEMS,
    MAX_U16,
    MAX_U32,
    PUBLISHER,
    SUBSCRIBER,
    EapBox,
    EapImportDevice,
    EapVariable,
    ImportOutcome,
    ImportReport,
    six_bytes,
    unknown_children,
)
from eap.ids import NET_ID, MacAddr, NetId

ROOTS = "TreeItem", "TreeItems"
NAMESPACE = "urn:eap-appliance:peer"
"""Of the settings that TwinCAT has no known element for."""
_DEVICE, _BOX, _VARIABLE = 2, 5, 7
_PUBLISHER_VARIABLE, _SUBSCRIBER_VARIABLE = 35, 36
_NO_MAC, _NO_NET_ID, _NO_IP = "00 00 00 00 00 00", "0.0.0.0.0.0", "255.255.255.255"
_PUBLISHER_KEYS = (
    "Udp", "PublisherNetId", "MacAddress", "IoDiv", "VLAN", "ArpInterval",
    "DisableSubscriberMonitoring", "TargetChangeable",
)  # fmt: skip
_SUBSCRIBER_KEYS = "PublisherNetId", "MulticastMacAddr", "MulticastIpAddr"
ResultT = TypeVar("ResultT")


class TreeItem(msgspec.Struct, frozen=True):
    """One item of a file with its place in the tree."""

    path: tuple[str, ...]
    element: XmlElement
    file: str


def read_tree_items(chunks: Iterable[bytes], file: str, report: ImportReport) -> list[TreeItem]:
    """Return all items of a file; a file that cannot be read is reported.

    Args:
        chunks: The content of the file.
        file: Its name, for findings.
        report: Takes the findings.
    """
    try:
        root = read_tree(chunks, roots=ROOTS)
        return list(_items(root, (), file))
    except XmlError as exc:
        report.add_error(file, exc)
    return []


def _items(element: XmlElement, parent: tuple[str, ...], file: str) -> Iterator[TreeItem]:
    path = parent
    if element.tag == "TreeItem":
        name = element.findtext("PathName")
        path = tuple(name.split("^")) if name else (*parent, element.findtext("ItemName"))
        yield TreeItem(path, element, file)
    for child in element.children:
        if child.tag in {"TreeItem", "Child", "Children"}:
            yield from _items(child, path, file)


def assemble(items: Sequence[TreeItem], report: ImportReport) -> tuple[EapImportDevice, ...]:
    """Return the EAP devices that *items* describe; what is wrong or of no use is reported."""
    return _Assembly(items, report).devices()


class _Assembly:
    """EAP devices while they are put together."""

    def __init__(self, items: Sequence[TreeItem], report: ImportReport) -> None:
        self._report = report
        self._items = items
        self._types: dict[tuple[str, ...], tuple[str, int]] = {}
        self._variables: dict[tuple[str, ...], list[EapVariable]] = {}
        self._boxes: dict[tuple[str, ...], list[EapBox]] = {}

    def devices(self) -> tuple[EapImportDevice, ...]:
        # From the inside out: each level takes those below it.
        cycles = [self._tried(each, _cycle_us) for each in self._items]
        cycle_us = next((each for each in cycles if each), 0)
        for item in self._items:
            self._tried(item, self._take_data)
        for item in self._items:
            self._tried(item, self._take_variable)
        for item in self._items:
            self._tried(item, self._take_box)
        found = [each for item in self._items if (each := self._tried(item, self._device))]
        for parent, boxes in self._boxes.items():
            # Boxes whose device has no file here: their device is known by its name only.
            name = parent[-1] if parent else "EAP device"
            first = boxes[0]
            found.append(
                EapImportDevice(name=name, boxes=tuple(boxes), file=first.file, line=first.line)
            )
        return tuple(
            msgspec.structs.replace(each, cycle_us=each.cycle_us or cycle_us) for each in found
        )

    def _tried(self, item: TreeItem, read: Callable[[TreeItem], ResultT]) -> ResultT | None:
        """Return what *read* makes of an item; None, with a finding, if it is invalid."""
        try:
            return read(item)
        except XmlError as exc:
            self._report.add_error(item.file, exc, item="/".join(item.path))
            return None

    def _take_data(self, item: TreeItem) -> None:
        definition = item.element.find("VarDef")
        if definition is not None:
            kind = definition.findtext("VarType")
            bits = definition.number_at("VarBitSize", 0, 8 * MAX_U16)
            # Below the variable, in its group: ...^Var 1^Outputs^VarData.
            owner = item.path[:-2] if item.path[-1] == DATA else item.path
            self._types[owner] = (kind, bits)

    def _take_variable(self, item: TreeItem) -> None:
        for tag in ("NvPubVarDef", "NvSubVarDef"):
            definition = item.element.find(tag)
            if definition is None:
                continue
            if definition.find("NvId") is None:
                raise XmlError(f"{tag} has no NvId", line=definition.line, expected="its ID")
            kind, bits = self._types.get(item.path, ("", 0))
            own = item.element.find("Variable")
            siblings = self._variables.setdefault(item.path[:-1], [])
            siblings.append(
                EapVariable(
                    name=item.path[-1],
                    nv_id=definition.number_at("NvId", 0, MAX_U16),
                    type=kind,
                    bits=bits,
                    version=0 if own is None else own.attribute_number("Version", 0, MAX_U16),
                    unknown=tuple(unknown_children(definition, ("NvId",))),
                    line=item.element.line,
                )
            )
            _check_count(siblings, item)

    def _take_box(self, item: TreeItem) -> None:
        for tag, read in (("NvPubDef", _publisher), ("NvSubDef", _subscriber)):
            definition = item.element.find(f"BoxDef/{tag}")
            if definition is None:
                continue
            box = read(definition)
            siblings = self._boxes.setdefault(item.path[:-1], [])
            siblings.append(
                msgspec.structs.replace(
                    box,
                    name=item.path[-1],
                    is_disabled=item.element.flag_at("Disabled"),
                    variables=tuple(self._variables.pop(item.path, ())),
                    file=item.file,
                    line=item.element.line,
                )
            )
            _check_count(siblings, item)

    def _device(self, item: TreeItem) -> EapImportDevice | None:
        element = item.element
        if element.find("DeviceDef") is None:
            return None
        kind = element.number_at("ItemSubType", 0, MAX_U32)
        name = item.path[-1]
        if kind != EAP_DEVICE:
            message = f"ItemSubType {kind}: no EAP device"
            self._report.note(item.file, element.line, name, ImportOutcome.LEFT, message)
            return None
        own = element.find("Device")
        return EapImportDevice(
            name=name,
            net_id=None if own is None else _net_id(own.get("NetId"), own.line),
            mac=_mac(element.findtext("DeviceDef/AddressInfo/Pnp/DeviceData"), element.line),
            cycle_us=0 if own is None else own.attribute_number("CycleUs", 0, MAX_U32),
            is_disabled=element.flag_at("Disabled"),
            boxes=tuple(self._boxes.pop(item.path, ())),
            file=item.file,
            line=element.line,
        )


def _check_count(siblings: Sequence[object], item: TreeItem) -> None:
    if len(siblings) > ITEMS:
        message = f"{'/'.join(item.path[:-1])} has too many items"
        raise XmlError(message, line=item.element.line, expected=f"at most {ITEMS}")


def _cycle_us(item: TreeItem) -> int:
    """Return the cycle of a task, 0 for any other item."""
    return item.element.number_at("TaskDef/CycleTime", 0, MAX_U32) // 10  # 100 ns


def _publisher(definition: XmlElement) -> EapBox:
    udp = definition.find("Udp")
    is_udp = udp is not None and udp.attribute_flag("Enabled")
    gateway = definition.findtext("Udp/Gateway") if is_udp else ""
    has_vlan = definition.flag_at("VLAN/Enable")
    line = definition.line
    return EapBox(
        name="",
        is_publisher=True,
        net_id=_net_id(definition.findtext("PublisherNetId"), line),
        # A MAC address of zeros means unicast to the NetID.
        mac="" if is_udp else _mac(definition.findtext("MacAddress"), line),
        udp=_ip(definition.findtext("Udp/Address"), line) if is_udp else "",
        gateway="" if gateway == _NO_IP else _ip(gateway, line),
        divider=definition.number_at("IoDiv/Divider", 1, MAX_U16, 1),
        modulo=definition.number_at("IoDiv/Modulo", 0, MAX_U16),
        vlan_id=definition.number_at("VLAN/Id", 0, 4094) if has_vlan else 0,
        vlan_priority=definition.number_at("VLAN/Prio", 0, 7) if has_vlan else 0,
        arp_ms=definition.number_at("ArpInterval", 0, MAX_U32, ARP_MS),
        is_monitored=not definition.flag_at("DisableSubscriberMonitoring"),
        is_changeable=definition.flag_at("TargetChangeable"),
        unknown=tuple(unknown_children(definition, _PUBLISHER_KEYS)),
    )


def _subscriber(definition: XmlElement) -> EapBox:
    line = definition.line
    group = definition.findtext("MulticastIpAddr")
    return EapBox(
        name="",
        is_publisher=False,
        net_id=_net_id(definition.findtext("PublisherNetId"), line),
        mac=_mac(definition.findtext("MulticastMacAddr"), line),
        udp="" if group == _NO_IP else _ip(group, line),
        unknown=tuple(unknown_children(definition, _SUBSCRIBER_KEYS)),
    )


def _net_id(text: str, line: int) -> NetId | None:
    if not text:
        return None
    try:
        net_id = NetId.parse(text)
    except ValueError:
        message = f"{text!r} is not an AMS NetID"
        raise XmlError(message, line=line, expected=NET_ID) from None
    return net_id if any(net_id) else None


def _mac(text: str, line: int) -> str:
    """Return a MAC address of hexadecimal digits; empty for none and for one of zeros."""
    if not text:
        return ""
    octets = six_bytes(text)
    if not octets:
        message = f"MAC address {text[:40]!r}"
        raise XmlError(message, line=line, expected="12 hexadecimal digits")
    return str(MacAddr(octets)) if any(octets) else ""


def _ip(text: str, line: int) -> str:
    if not text:
        return ""
    try:
        return str(IPv4Address(text))
    except ValueError:
        raise XmlError(f"address {text[:40]!r}", line=line, expected="an IPv4 address") from None


def tree_items_text(devices: Iterable[EapImportDevice]) -> str:
    """Return one file with all items of *devices*."""
    items = "".join(text for device in devices for _, text in device_items(device))
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n'
        "<!-- TwinCAT imports each TreeItem into the item of its PathName. -->\n"
        f'<TreeItems xmlns:eap="{NAMESPACE}">\n{items}</TreeItems>\n'
    )


def device_items(device: EapImportDevice) -> Iterator[tuple[str, str]]:
    """Yield path and text of each item of *device*: its own, and those of boxes and variables."""
    root = f"TIID^{device.name}"
    net_id = f" NetId={quoteattr(str(device.net_id))}" if device.net_id else ""
    address = ""
    if device.mac:
        digits = device.mac.replace(":", "")
        address = f"<AddressInfo><Pnp><DeviceData>{digits}</DeviceData></Pnp></AddressInfo>"
    definition = (
        f"<DeviceDef>{address}</DeviceDef>",
        f'<eap:Device{net_id} CycleUs="{device.cycle_us}"/>',
    )
    yield _item(root, _DEVICE, EAP_DEVICE, definition, is_disabled=device.is_disabled)
    for box in device.boxes:
        path = f"{root}^{box.name}"
        kind = PUBLISHER if box.is_publisher else SUBSCRIBER
        settings = _publisher_lines(box) if box.is_publisher else _subscriber_lines(box)
        lines = ("<BoxDef>", *(f"  {line}" for line in settings), "</BoxDef>")
        yield _item(path, _BOX, kind, lines, is_disabled=box.is_disabled)
        for variable in box.variables:
            yield from _variable_items(f"{path}^{variable.name}", variable, box)


def _variable_items(path: str, variable: EapVariable, box: EapBox) -> Iterator[tuple[str, str]]:
    tag, kind, group = "NvSubVarDef", _SUBSCRIBER_VARIABLE, "Inputs"
    if box.is_publisher:
        tag, kind, group = "NvPubVarDef", _PUBLISHER_VARIABLE, "Outputs"
    yield _item(
        path,
        kind,
        0,
        (
            f"<{tag}><NvId>{variable.nv_id}</NvId></{tag}>",
            f'<eap:Variable Version="{variable.version}"/>',
        ),
    )
    size = f"<VarBitSize>{variable.bits}</VarBitSize>"
    definition = f"<VarDef><VarType>{escape(variable.type)}</VarType>{size}</VarDef>"
    yield _item(f"{path}^{group}^{DATA}", _VARIABLE, 0, (definition,))


def _item(
    path: str, kind: int, subtype: int, definition: Iterable[str], *, is_disabled: bool = False
) -> tuple[str, str]:
    lines = [
        f"<ItemName>{escape(path.rpartition('^')[2])}</ItemName>",
        f"<PathName>{escape(path)}</PathName>",
        f"<ItemType>{kind}</ItemType>",
        f"<ItemSubType>{subtype}</ItemSubType>",
        *(("<Disabled>1</Disabled>",) if is_disabled else ()),
        *definition,
    ]
    inner = "".join(f"    {line}\n" for line in lines)
    return path, f'  <TreeItem xmlns:eap="{NAMESPACE}">\n{inner}  </TreeItem>\n'


def _publisher_lines(box: EapBox) -> Iterator[str]:
    yield "<NvPubDef>"
    if box.udp:
        gateway = box.gateway or _NO_IP
        inner = f"<Address>{box.udp}</Address><Gateway>{gateway}</Gateway>"
        yield f'  <Udp Enabled="1">{inner}</Udp>'
    else:
        yield '  <Udp Enabled="0"/>'
    yield f"  <PublisherNetId>{box.net_id or _NO_NET_ID}</PublisherNetId>"
    yield f"  <MacAddress>{box.mac.replace(':', ' ') or _NO_MAC}</MacAddress>"
    yield f"  <IoDiv><Divider>{box.divider}</Divider><Modulo>{box.modulo}</Modulo></IoDiv>"
    vlan = f"<Id>{box.vlan_id}</Id><Prio>{box.vlan_priority}</Prio>"
    yield f"  <VLAN><Enable>{int(bool(box.vlan_id))}</Enable>{vlan}</VLAN>"
    yield f"  <ArpInterval>{box.arp_ms}</ArpInterval>"
    is_off = int(not box.is_monitored)
    yield f"  <DisableSubscriberMonitoring>{is_off}</DisableSubscriberMonitoring>"
    yield f"  <TargetChangeable>{int(box.is_changeable)}</TargetChangeable>"
    yield "</NvPubDef>"


def _subscriber_lines(box: EapBox) -> Iterator[str]:
    yield "<NvSubDef>"
    yield f"  <PublisherNetId>{box.net_id or _NO_NET_ID}</PublisherNetId>"
    if box.udp:
        yield f"  <MulticastIpAddr>{box.udp}</MulticastIpAddr>"
    else:
        yield f"  <MulticastMacAddr>{box.mac.replace(':', ' ') or _NO_MAC}</MulticastMacAddr>"
    yield "</NvSubDef>"
