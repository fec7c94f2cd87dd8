"""Projects of TwinCAT 3: EAP devices of ``.tsproj`` and ``.xti`` files.

Beckhoff publishes no schema: elements and attributes are those of the projects that users and
Beckhoff itself have published.  An attribute or element of a publisher or subscriber that none of
them has is kept as unknown.

A project may keep devices and boxes in files of their own (``File="Device 1 (X).xti"``).  Those of
devices are in ``_Config/IO``, those of boxes in a folder there with the name of the file of their
device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

import msgspec

from eap.codec.xmlstream import XmlElement, XmlError, XmlReader
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
    UnknownSetting,
    six_bytes,
    unknown_attributes,
    unknown_children,
)
from eap.config.imports.typefile import IGNORED, TSPROJ_TYPE, TypeRecord, read_types
from eap.ids import NET_ID, MacAddr, NetId

OpenFile: TypeAlias = Callable[[str], Iterable[bytes]]
"""Opens a file by its path; raises OSError."""

PROJECT, ITEM = "TcSmProject", "TcSmItem"
_PROJECT = f"{PROJECT}/Project"
_WANTED = (
    TSPROJ_TYPE,
    f"{_PROJECT}/System/Tasks/Task",
    f"{_PROJECT}/Plc/Project",
    f"{_PROJECT}/Io/Device",
    f"{PROJECT}/Mappings/OwnerA",
    f"{ITEM}/Device",
    f"{ITEM}/Box",
    f"{ITEM}/DataTypes/DataType",
    f"{ITEM}/Mappings/OwnerA",
    f"{ITEM}/Mappings/OwnerB",
)
IO_FOLDER = "_Config/IO"
MAX_FILES = 2000
"""Limit of the files of one project."""
_FILE_NAME = "__FILENAME__"
"""Name of an item that is called like its file."""
_DEVICE_TYPES = {
    111: "EtherCAT master: an ENI file, or 'eapctl bus scan --write', describes its slaves",
    138: "Real-Time Ethernet adapter: network variables of TwinCAT 2 are not read from it",
}
_STATES = frozenset(
    ("FrameState", "FrameCtrl", "VarState", "VarCtrl", "Quality", "CycleIndex", "CycleIdx")
)
_BOX_ATTRIBUTES = "Id", "BoxType", "File", "Disabled", "AmsPort", "RemoteName"
_BOX_CHILDREN = "Name", "Comment", "ImageId", "Vars", "Eap"
_EAP_ATTRIBUTES = "InOut", "Publisher", "ArpRetryInterval"
_VARIABLE_ATTRIBUTES = "Id", "VarInOut", "NvId", "NvLength"
_VARIABLE_CHILDREN = "Name", "Comment", "ImageId", "Vars"


class TwinCatProject(msgspec.Struct, frozen=True, kw_only=True):
    """The parts of a project that concern EAP.

    Attributes:
        file: Its file.
        net_id: NetID of the target system; None without one.
        devices: Its EAP devices.
        cycles_us: Cycles of its tasks.
        types: Data types.
    """

    file: str
    net_id: NetId | None = None
    devices: tuple[EapImportDevice, ...] = ()
    cycles_us: tuple[int, ...] = ()
    types: tuple[TypeRecord, ...] = ()


def read_project(file: str, open_file: OpenFile, report: ImportReport) -> TwinCatProject:
    """Read a ``.tsproj`` or ``.xti`` file with the files that it names.

    Args:
        file: Its path, for *open_file* and for findings; those of the others are made of it.
        open_file: Opens files.
        report: Takes notes and findings.
    """
    return _Project(file, open_file, report).read()


class _Link(msgspec.Struct, frozen=True):
    """A link between a variable of a program and one of an EAP device."""

    owner: str
    symbol: str


class _Project:
    """One project while it is read."""

    def __init__(self, file: str, open_file: OpenFile, report: ImportReport) -> None:
        self._file = file
        self._open = open_file
        self._report = report
        self._types: list[XmlElement] = []
        self._tasks: list[tuple[str, int]] = []
        """Name and cycle of each task."""
        self._contexts: dict[str, int] = {}
        """Cycle of each group of variables: ``TIPC^PLC^Instance^PlcTask Inputs``."""
        self._devices: list[tuple[XmlElement, str]] = []
        self._mappings: list[tuple[XmlElement, str]] = []
        self._links: dict[str, _Link] = {}
        self._net_id: NetId | None = None
        self._files = 0
        folder = file.rpartition("/")[0] or "."
        # The file of a device lies in that folder itself.
        self._folder = folder if _is_item(file) else f"{folder}/{IO_FOLDER}"

    def read(self) -> TwinCatProject:
        """Return what the project has for EAP."""
        self._read_file(self._file, (PROJECT, ITEM))
        found = [self._device(element, file) for element, file in self._devices]
        devices = [each for each in found if each is not None]
        for element, item in self._mappings:
            self._read_links(element, item)
        return TwinCatProject(
            file=self._file,
            net_id=self._net_id,
            devices=tuple(self._linked(each) for each in devices),
            cycles_us=tuple({cycle_us for _, cycle_us in self._tasks if cycle_us}),
            types=tuple(read_types(self._types, self._file, self._report)),
        )

    def _read_file(self, file: str, roots: tuple[str, ...]) -> list[XmlElement]:
        """Read one file, collect what it has, and return its devices and boxes."""
        reader = XmlReader(_WANTED, roots=roots, ignored=IGNORED)
        items: list[XmlElement] = []
        if not self._may_open_another():
            return items
        try:
            for element in reader.read(self._open(file)):
                self._take(element, file, items)
        except XmlError as exc:
            self._report.add_error(file, exc)
        except OSError as exc:
            message = f"cannot be read: {exc.strerror or exc}"
            self._report.add(file, 0, message, "a file of the project, in its folder")
        project = reader.above(_PROJECT)
        if project is not None and (text := project.get("TargetNetId")):
            net_id = self._parse_net_id(text, file, project.line)
            self._net_id = net_id if net_id and any(net_id) else None
        if file == self._file and reader.root is not None and reader.root.tag == ITEM:
            self._take_items(items, file)
        return items

    def _may_open_another(self) -> bool:
        self._files += 1
        if self._files == MAX_FILES + 1:
            message = "the project names too many files"
            self._report.add(self._file, 0, message, f"at most {MAX_FILES}")
        return self._files <= MAX_FILES

    def _take_items(self, items: list[XmlElement], file: str) -> None:
        """Take the device of a file that is no project."""
        self._devices += [(each, file) for each in items if each.tag == "Device"]
        for each in items:
            if each.tag == "Box" and each.get("BoxType") in {str(PUBLISHER), str(SUBSCRIBER)}:
                message = "a box without its device: its NetID is unknown"
                expected = "the file of its device, or the project"
                self._report.add(file, each.line, message, expected)

    def _take(self, element: XmlElement, file: str, items: list[XmlElement]) -> None:
        match element.tag:
            case "DataType":
                self._types.append(element)
            case "Task":
                cycle_us = element.attribute_number("CycleTime", 0, MAX_U32) // 10  # 100 ns
                self._tasks.append((element.findtext("Name"), cycle_us))
            case "Project":
                self._read_plc(element)
            case "Device" if file == self._file and not _is_item(file):
                self._devices.append((element, file))
            case "OwnerA" | "OwnerB":
                self._mappings.append((element, file))
            case _:
                items.append(element)

    def _read_plc(self, plc: XmlElement) -> None:
        for instance in plc.iterfind("Instance"):
            path = f"TIPC^{plc.get('Name')}^{instance.findtext('Name')}"
            for context in instance.iterfind("Contexts/Context"):
                cycle_us = context.number_at("CycleTime", 0, 1 << 63) // 1000  # ns
                for group in ("Inputs", "Outputs"):
                    self._contexts[f"{path}^{context.findtext('Name')} {group}"] = cycle_us

    def _device(self, element: XmlElement, file: str) -> EapImportDevice | None:
        """Return the EAP device of *element*, which may be in a file of its own."""
        found = self._resolve_file(element, file, self._folder)
        if found is None:
            return None
        element, file = found
        title = _name(element, file)
        folder = f"{self._folder}/{_stem(file) if _is_item(file) else title}"
        try:
            kind = element.attribute_number("DevType", 0, MAX_U16)
            if kind != EAP_DEVICE:
                reason = _DEVICE_TYPES.get(kind, "no EAP device")
                message = f"DevType {kind}: {reason}"
                self._report.note(file, element.line, title, ImportOutcome.LEFT, message)
                return None
            return self._eap_device(element, title, file, folder)
        except XmlError as exc:
            self._report.add_error(file, exc, item=title)
            return None

    def _resolve_file(
        self, element: XmlElement, file: str, folder: str
    ) -> tuple[XmlElement, str] | None:
        """Return *element*, or the one in the file in *folder* that it names, with its file."""
        name = element.get("File")
        if not name:
            return element, file
        if not self._is_inside(name, file, element.line):
            return None
        file = f"{folder}/{name}"
        before = len(self._report.findings)
        found = [each for each in self._read_file(file, (ITEM,)) if each.tag == element.tag]
        if not found and len(self._report.findings) == before:
            message = f"its file has no {element.tag}"
            self._report.note(file, 0, _stem(file), ImportOutcome.LEFT, message)
        return (found[0], file) if found else None

    def _eap_device(
        self, element: XmlElement, title: str, file: str, folder: str
    ) -> EapImportDevice:
        text = element.get("AmsNetId")
        net_id = self._parse_net_id(text, file, element.line) if text else None
        if net_id is not None and not any(net_id[:4]):
            # So it is in a project that was never given a target.
            message = f"its AmsNetId {net_id} belongs to no system"
            self._report.note(file, element.line, title, ImportOutcome.WARNING, message)
            net_id = None
        boxes = [self._box(each, title, file, folder) for each in element.iterfind("Box")]
        if len(boxes) > ITEMS:
            message = f"{title} has {len(boxes)} boxes"
            raise XmlError(message, line=element.line, expected=f"at most {ITEMS}")
        return EapImportDevice(
            name=title,
            net_id=net_id,
            mac=_mac(element.findtext("AddressInfo/Pnp/DeviceData")),
            is_disabled=element.attribute_flag("Disabled"),
            boxes=tuple(each for each in boxes if each is not None),
            file=file,
            line=element.line,
        )

    def _box(self, element: XmlElement, device: str, file: str, folder: str) -> EapBox | None:
        found = self._resolve_file(element, file, folder)
        if found is None:
            return None
        element, file = found
        title = _name(element, file)
        item = f"{device}/{title}"
        try:
            kind = element.attribute_number("BoxType", 0, MAX_U16)
            if kind not in {PUBLISHER, SUBSCRIBER}:
                message = f"BoxType {kind}: neither publisher nor subscriber"
                self._report.note(file, element.line, item, ImportOutcome.LEFT, message)
                return None
            return self._eap_box(element, title, item, file, is_publisher=kind == PUBLISHER)
        except XmlError as exc:
            self._report.add_error(file, exc, item=item)
            return None

    def _eap_box(
        self, element: XmlElement, title: str, item: str, file: str, *, is_publisher: bool
    ) -> EapBox:
        unknown = unknown_attributes(element, _BOX_ATTRIBUTES)
        unknown += unknown_children(element, _BOX_CHILDREN)
        variables: list[EapVariable] = []
        publisher, arp_ms = "", ARP_MS
        line = element.line
        for eap in element.iterfind("Eap"):
            unknown += unknown_attributes(eap, _EAP_ATTRIBUTES)
            unknown += unknown_children(eap, ("EapVar",))
            publisher, line = eap.get("Publisher", publisher), eap.line
            arp_ms = eap.attribute_number("ArpRetryInterval", 0, MAX_U32, arp_ms)
            for each in eap.iterfind("EapVar"):
                variable = self._variable(each, item, file)
                if variable is not None:
                    variables.append(variable)
        if len(variables) > ITEMS:
            message = f"{item} has {len(variables)} variables"
            raise XmlError(message, line=line, expected=f"at most {ITEMS}")
        return EapBox(
            name=title,
            is_publisher=is_publisher,
            net_id=_hex_net_id(publisher, line),
            arp_ms=arp_ms,
            is_disabled=element.attribute_flag("Disabled"),
            variables=tuple(variables),
            unknown=tuple(unknown),
            file=file,
            line=element.line,
        )

    def _variable(self, element: XmlElement, box: str, file: str) -> EapVariable | None:
        name = element.findtext("Name")
        try:
            return _variable(element, name)
        except XmlError as exc:
            self._report.add_error(file, exc, item=f"{box}/{name}")
            return None

    def _parse_net_id(self, text: str, file: str, line: int) -> NetId | None:
        try:
            return NetId.parse(text)
        except ValueError:
            self._report.add(file, line, f"{text!r} is not an AMS NetID", NET_ID)
            return None

    def _is_inside(self, name: str, file: str, line: int) -> bool:
        """Return whether a file that a project names lies where it belongs."""
        parts = name.replace("\\", "/").split("/")
        if len(parts) == 1 and parts[0] not in {"", ".", ".."} and ":" not in name:
            return True
        message = f"File {name!r} leads out of the folder of the project"
        self._report.add(file, line, message, "the name of a file in the folder")
        return False

    def _read_links(self, owner: XmlElement, file: str) -> None:
        """Note the links of one owner; in the file of a device the owner may be that device."""
        # In the file of a device either side is the owner, and the device itself has no name.
        for other in owner.iterfind("OwnerB" if owner.tag == "OwnerA" else "OwnerA"):
            names = owner.get("Name"), other.get("Name")
            devices = [each for each in names if not each or each.startswith("TIID^")]
            programs = [each for each in names if each.startswith(("TIPC^", "TIRT^", "TIRC^"))]
            if not devices or not programs:
                continue
            own = devices[0] or f"TIID^{_stem(file)}"
            is_program_first = names[0] == programs[0]
            for link in other.iterfind("Link"):
                first, second = link.get("VarA"), link.get("VarB")
                if owner.tag == "OwnerB":
                    first, second = second, first
                symbol, target = (first, second) if is_program_first else (second, first)
                self._links[f"{own}^{target}"] = _Link(programs[0], symbol)

    def _linked(self, device: EapImportDevice) -> EapImportDevice:
        boxes = []
        for box in device.boxes:
            group = "Outputs" if box.is_publisher else "Inputs"
            prefix = f"TIID^{device.name}^{box.name}"
            variables = []
            for variable in box.variables:
                link = self._links.get(f"{prefix}^{variable.name}^{group}^{DATA}")
                if link is not None:
                    variable = msgspec.structs.replace(  # noqa: PLW2901
                        variable,
                        symbol=link.symbol.rpartition("^")[2],
                        cycle_us=self._cycle_of(link),
                    )
                variables.append(variable)
            boxes.append(msgspec.structs.replace(box, variables=tuple(variables)))
        return msgspec.structs.replace(device, boxes=tuple(boxes))

    def _cycle_of(self, link: _Link) -> int:
        """Return the cycle of the task that a linked variable belongs to; 0 if it is unknown."""
        # Group and variable of a PLC: PlcTask Outputs^MAIN.nIndex.
        group = link.symbol.split("^")[0]
        found = self._contexts.get(f"{link.owner}^{group}")
        if found is not None:
            return found
        task = link.owner.rpartition("^")[2]
        return next((cycle_us for name, cycle_us in self._tasks if name == task), 0)


def _variable(element: XmlElement, name: str) -> EapVariable:
    inner = list(element.iterfind("Vars/Var"))
    data = next((each for each in inner if each.findtext("Name") == DATA), None)
    kind = None if data is None else data.find("Type")
    unknown = unknown_attributes(element, _VARIABLE_ATTRIBUTES)
    unknown += unknown_children(element, _VARIABLE_CHILDREN)
    unknown += [
        UnknownSetting(each.line, f"Var {each.findtext('Name')}")
        for each in inner
        if each.findtext("Name") not in _STATES | {DATA}
    ]
    if not element.get("NvId"):
        message, expected = f"EapVar {name!r} has no NvId", "the attribute NvId"
        raise XmlError(message, line=element.line, expected=expected)
    return EapVariable(
        name=name,
        nv_id=element.attribute_number("NvId", 0, MAX_U16),
        type="" if kind is None else kind.text,
        guid="" if kind is None else kind.get("GUID").upper(),
        # In bytes, with the end of a text: 256 for STRING(255).
        bits=8 * element.attribute_number("NvLength", 0, MAX_U16),
        unknown=tuple(unknown),
        line=element.line,
    )


def _name(element: XmlElement, file: str) -> str:
    name = element.findtext("Name")
    return _stem(file) if name in {"", _FILE_NAME} else name


def _is_item(file: str) -> bool:
    return file.lower().endswith(".xti")


def _stem(file: str) -> str:
    name = file.rpartition("/")[2]
    return name[:-4] if _is_item(name) else name


def _hex_net_id(text: str, line: int) -> NetId | None:
    """Return the NetID of 12 hexadecimal digits; None for none and for one of zeros."""
    if not text:
        return None
    octets = six_bytes(text)
    if not octets:
        message, expected = f"Publisher is {text[:40]!r}", "a NetID of 12 hexadecimal digits"
        raise XmlError(message, line=line, expected=expected)
    return NetId(octets) if any(octets) else None


def _mac(text: str) -> str:
    """Return the MAC address of 12 hexadecimal digits; empty if it is none."""
    octets = six_bytes(text)
    # No adapter has a group address.
    return str(MacAddr(octets)) if any(octets) and not octets[0] & 1 else ""
