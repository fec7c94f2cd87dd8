"""Content of an ESI file: the list of its devices, and single devices in full."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

import msgspec

from devicebus.esi.device import identify, read_device, read_module
from devicebus.esi.fields import EsiFinding, Fields, english
from devicebus.esi.records import EsiDevice, EsiModule
from eap.codec.xmlstream import CHUNK, XmlElement, XmlError, XmlReader

ROOT = "EtherCATInfo"
MAX_DEVICES = 20_000
MAX_MODULES = 20_000
_VENDOR = f"{ROOT}/Vendor"
_DEVICE = f"{ROOT}/Descriptions/Devices/Device"
_MODULE = f"{ROOT}/Descriptions/Modules/Module"
# The files of one vendor may have 180 MB: a list reads no more of a device than this.
_HEAD = ("Type", "HideType", "Name")
# Pictures are much of some files, and nothing here shows them.
_IGNORED = ("ImageData16x14", "Image16x14", "ImageFile16x14", "URL")


class ListedDevice(msgspec.Struct, frozen=True, kw_only=True):
    """Device in the list of a file."""

    vendor: int
    product: int
    revision: int
    number: int
    """Position in the file."""
    line: int
    type: str = ""
    name: str = ""
    hides: tuple[int, ...] = ()
    """Older revisions of the product that it hides from menus."""


class EsiList(msgspec.Struct, frozen=True, kw_only=True):
    """Devices of a file and its faults."""

    vendor: int = 0
    vendor_name: str = ""
    devices: tuple[ListedDevice, ...] = ()
    findings: tuple[EsiFinding, ...] = ()


class DeviceResult(msgspec.Struct, frozen=True):
    """A device, or None and the reasons; the findings of a device that can be used are empty."""

    device: EsiDevice | None
    findings: tuple[EsiFinding, ...]


def list_devices(stream: BinaryIO) -> EsiList:
    """Return the devices of a file; a fault ends the list with a finding.

    Raises OSError only.
    """
    fields = Fields()
    found: list[_DeviceHead] = []
    wanted = (_VENDOR, *(f"{_DEVICE}/{tag}" for tag in _HEAD))
    vendor, vendor_name = 0, ""
    for element in _read(stream, fields, wanted):
        if element.tag == "Vendor":
            vendor, vendor_name = fields.child(element, "Id"), english(element)
        elif element.tag == "Type":
            if len(found) == MAX_DEVICES:
                fields.report(element.line, f"more than {MAX_DEVICES} devices", "a smaller file")
                break
            found.append(_DeviceHead(element, [], []))
        elif found:
            (found[-1].hides if element.tag == "HideType" else found[-1].names).append(element)
    return EsiList(
        vendor=vendor,
        vendor_name=vendor_name,
        devices=tuple(_listed(number, vendor, each, fields) for number, each in enumerate(found)),
        findings=tuple(fields.findings),
    )


def load_device(stream: BinaryIO, listed: ListedDevice) -> DeviceResult:
    """Return a device of a file with the modules that fit its slots.

    The stream must be seekable: modules follow the devices, and are read for a device with slots
    only.  Raises OSError only.
    """
    fields = Fields()
    seen = vendor = 0
    vendor_name = ""

    def select(element: XmlElement) -> bool:
        # A device without a type is in no list: those behind it come later than they are listed.
        nonlocal seen
        seen += element.tag == "Device"
        return element.tag == "Vendor" or seen > listed.number

    for element in _read(stream, fields, (_VENDOR, _DEVICE), select):
        if element.tag == "Vendor":
            vendor, vendor_name = fields.child(element, "Id"), english(element)
            continue
        # Faults of devices before the wanted one do not count.
        own = identify(element, Fields())
        if (own.product, own.revision, own.type) == (listed.product, listed.revision, listed.type):
            device = read_device(element, vendor, vendor_name, fields)
            return _with_modules(device, stream, element.line, fields)
    if not fields.findings:
        message = f"the file has no {listed.type} (revision 0x{listed.revision:08X}) any more"
        fields.report(0, message, "the file as it was listed")
    return DeviceResult(None, tuple(fields.findings))


class _DeviceHead(NamedTuple):
    """Elements of a device for the list."""

    type: XmlElement
    hides: list[XmlElement]
    names: list[XmlElement]


def _listed(number: int, vendor: int, head: _DeviceHead, fields: Fields) -> ListedDevice:
    device = XmlElement("Device", {}, head.type.line)
    device.children = [head.type, *head.names]
    own = identify(device, fields)
    return ListedDevice(
        vendor=vendor,
        product=own.product,
        revision=own.revision,
        number=number,
        line=head.type.line,
        type=own.type,
        name=own.name,
        hides=tuple(fields.attribute(each, "RevisionNo") for each in head.hides),
    )


def _with_modules(device: EsiDevice, stream: BinaryIO, line: int, fields: Fields) -> DeviceResult:
    if device.slots:
        stream.seek(0)
        device = msgspec.structs.replace(device, modules=tuple(_modules(stream, device, fields)))
        _check_slots(device, line, fields)
    findings = tuple(sorted(fields.findings))
    return DeviceResult(None if findings else device, findings)


def _modules(stream: BinaryIO, device: EsiDevice, fields: Fields) -> Iterator[EsiModule]:
    """Yield the modules that fit the slots of a device."""
    idents = {ident for slot in device.slots for ident in slot.idents}
    classes = {name for slot in device.slots for name in slot.classes}
    quiet = Fields()  # modules of other devices may be wrong
    count = 0
    for element in _read(stream, fields, (_MODULE,)):
        kind = element.find("Type")
        if kind is None or not (
            quiet.attribute(kind, "ModuleIdent") in idents or kind.get("ModuleClass") in classes
        ):
            continue
        count += 1
        if count > MAX_MODULES:
            fields.report(element.line, f"more than {MAX_MODULES} modules", "a smaller file")
            return
        yield read_module(element, device.sync_managers, fields)


def _check_slots(device: EsiDevice, line: int, fields: Fields) -> None:
    """Report default modules that the file does not have."""
    known = {module.ident for module in device.modules}
    for number, slot in enumerate(device.slots):
        if slot.default is not None and slot.default not in known:
            message = f"{device.label}: the module 0x{slot.default:08X} of slot {number} is missing"
            fields.report(line, message, "a module of the file")


def _read(
    stream: BinaryIO,
    fields: Fields,
    wanted: tuple[str, ...],
    select: Callable[[XmlElement], bool] | None = None,
) -> Iterator[XmlElement]:
    """Yield the wanted elements; a fault of the file is a finding and ends them."""
    chunks = iter(lambda: stream.read(CHUNK), b"")
    reader = XmlReader(wanted, roots=(ROOT,), ignored=_IGNORED, select=select)
    try:
        yield from reader.read(chunks)
    except XmlError as exc:
        fields.report(exc.line, str(exc), exc.expected)
