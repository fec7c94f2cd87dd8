"""Bus file of the slaves that are found on a bus: identities, names, process data."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

import msgspec

from devicebus.esi.choice import DETECTED_MODULES, MAX_MODULE_LIST, DeviceQuery, plan_device
from devicebus.esi.names import legal
from devicebus.esi.records import EsiDevice
from devicebus.mailbox import coe_client
from devicebus.master import eeprom
from devicebus.master.image import ProcessVariable, data_type_of
from devicebus.master.pdo import Pdo, PdoEntry, ProcessDataChannel, channels_from_sii, read_channels
from devicebus.master.procedure import read
from devicebus.wire import sii
from devicebus.wire.register import Register
from devicebus.wire.sii import Sii, SiiProtocol
from eap.errors import EapError
from eap.od.slave_config import RevisionRule
from eap.ops.bus_session import Begin, Slave, SlaveBus
from eap.runtime.esi_files import EsiSource

_MAX_MAILBOX, _MIN_MAILBOX = 1486, 32
_CLOCK = 0x04
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")
_RESERVED = frozenset(("null", "true", "false", "yes", "no", "on", "off", "y", "n"))
_PLAIN_NAMES = frozenset(("", "Outputs", "Inputs"))
_RANGES = (range(0x1600, 0x1800), range(0x1A00, 0x1C00))


class WrittenSlave(msgspec.Struct, frozen=True, kw_only=True):
    """Slave of the written bus file."""

    address: int
    name: str
    device: str = ""
    """Type in its ESI file; empty without a description by the vendor."""
    file: str = ""
    """That file."""
    notes: tuple[str, ...] = ()
    """Differences between the slave and its description in the file."""


class WrittenBus(msgspec.Struct, frozen=True):
    """``eapctl bus scan --write``."""

    file: str
    slaves: list[WrittenSlave]
    faults: list[str]
    """Faults of ESI files, whose devices could not all be listed, and a source without devices."""


class FoundDescription(msgspec.Struct, frozen=True, kw_only=True):
    """Slave with everything that a bus file says of it."""

    slave: Slave
    name: str
    content: Sii
    channels: tuple[ProcessDataChannel, ...] = ()
    device: EsiDevice | None = None
    file: Path | None = None
    modules: tuple[int, ...] = ()
    has_clock: bool = True
    notes: tuple[str, ...] = ()


def describe_slaves(bus: SlaveBus, source: EsiSource | None) -> list[FoundDescription]:
    """Return what can be found about every slave, in the order of the line.

    Raises:
        BusError: the bus cannot be scanned, or an EEPROM cannot be read.
    """
    taken: set[str] = set()
    present = [slave for slave in bus.scan() if not slave.is_absent]
    return [_describe(bus, slave, source, taken) for slave in present]


def _describe(
    bus: SlaveBus, slave: Slave, source: EsiSource | None, taken: set[str]
) -> FoundDescription:
    what = f"slave {slave.station}: its EEPROM"
    content = sii.decode(bus.run(eeprom.read_image(slave.station), what))
    notes: list[str] = []
    device, file = _find_device(slave, source, notes)
    channels = _channels(bus, slave, content, notes)
    modules: tuple[int, ...] = ()
    if device is not None and device.slots:
        modules = _modules(bus, slave, notes)
    (features, *_) = bus.run(read(slave.station, Register.FEATURES, 2, "features"), what)
    return FoundDescription(
        slave=slave,
        name=_free_name(slave, content, device, taken),
        content=content,
        channels=channels,
        device=device,
        file=file,
        modules=modules,
        has_clock=bool(features & _CLOCK),
        notes=tuple(notes),
    )


def _find_device(
    slave: Slave, source: EsiSource | None, notes: list[str]
) -> tuple[EsiDevice | None, Path | None]:
    if source is None or not source.devices:
        return None, None
    query = DeviceQuery(slave.vendor, slave.product, "", slave.revision)
    found = source.match(query)
    if found is None:
        notes.append(f"no description of {query}, revision 0x{slave.revision:08X} or older")
        return None, None
    device, (file, listed) = found.device, found.located
    if device is None:
        notes.append(f"{listed.type} cannot be used: {found.findings[0]}")
        return None, None
    if device.revision != slave.revision:
        notes.append(
            f"described as revision 0x{device.revision:08X}, it has 0x{slave.revision:08X}"
        )
    return device, file


def _channels(
    bus: SlaveBus, slave: Slave, content: Sii, notes: list[str]
) -> tuple[ProcessDataChannel, ...]:
    if content.fixed.protocols & SiiProtocol.COE:
        try:
            return bus.converse(slave, lambda _: read_channels(content), "reading PDOs")
        except EapError as exc:
            notes.append(f"its PDOs are those of the EEPROM: {exc}")
    return channels_from_sii(content)


def _modules(bus: SlaveBus, slave: Slave, notes: list[str]) -> tuple[int, ...]:
    """Return the idents of the modules that a slave detects, 0 for an empty slot."""
    try:
        octets = bus.converse(slave, _upload(DETECTED_MODULES, 0), "counting modules")
        idents = []
        for subindex in range(1, min(octets[0], MAX_MODULE_LIST) + 1 if octets else 0):
            ident = bus.converse(slave, _upload(DETECTED_MODULES, subindex), "modules")
            idents.append(int.from_bytes(ident, "little"))
    except EapError as exc:
        notes.append(f"its modules are not known, the usual ones are assumed: {exc}")
        return ()
    while idents and not idents[-1]:
        idents.pop()
    return tuple(idents)


def _upload(index: int, subindex: int) -> Begin[bytes]:
    return lambda _: coe_client.upload(index, subindex)


def _free_name(slave: Slave, content: Sii, device: EsiDevice | None, taken: set[str]) -> str:
    """Return a unique name: its own if that can be a name in a bus file, else its type."""
    order = content.string(content.general.order) if content.general else ""
    text = slave.name
    if legal(text) != text:
        text = (device.type if device is not None else "") or order or text
    base = legal(text).strip("_") or f"slave_{slave.station}"
    name = base
    for number in count(2):
        if name not in taken:
            break
        name = f"{base}_{number}"
    taken.add(name)
    return name


def written(file: Path, found: Sequence[FoundDescription], source: EsiSource | None) -> WrittenBus:
    """Return the result of writing *found* to *file*."""
    faults = [] if source is None else [str(each) for each in source.findings()]
    if source is not None and not source.devices:
        faults.append(str(source.no_device))
    return WrittenBus(
        str(file),
        [
            WrittenSlave(
                address=each.slave.station,
                name=each.name,
                device=each.device.type if each.device is not None else "",
                file="" if each.file is None else str(each.file),
                notes=each.notes,
            )
            for each in found
        ],
        faults,
    )


def bus_text(bus: str, folder: Path, found: Sequence[FoundDescription]) -> str:
    """Return a bus file for *folder* that describes *found*."""
    lines = [f"bus: {_scalar(bus)}", "slaves:"]
    for number, each in enumerate(found):
        lines += [f"  # {note}" for note in each.notes]
        wiring = dict(_wiring(number, found))
        lines += _from_esi(each, folder, wiring) if each.device else _from_eeprom(each, wiring)
    return "\n".join([*lines, ""])


def _wiring(number: int, found: Sequence[FoundDescription]) -> Iterator[tuple[str, str]]:
    slave = found[number].slave
    if slave.parent is None or not 0 <= slave.parent < number:
        return
    if slave.parent != number - 1:
        yield "after", _scalar(found[slave.parent].name)
    if slave.parent_port != 1:
        yield "port", str(slave.parent_port)


def _from_esi(each: FoundDescription, folder: Path, wiring: Mapping[str, str]) -> Iterator[str]:
    device = each.device
    assert device is not None  # noqa: S101  checked by the caller
    keys = {
        "name": _scalar(each.name),
        "kind": "esi",
        "esi": _scalar(_path(each.file or Path(), folder)),
        "device": _scalar(device.type),
        "product": f"0x{device.product:08X}",
        "revision": f"0x{device.revision:08X}",
        **_alias(each),
        **wiring,
    }
    if each.modules:
        idents = (f"0x{ident:X}" if ident else "null" for ident in each.modules)
        keys["modules"] = f"[{', '.join(idents)}]"
    if master := dict(_master(each, device)):
        keys["master"] = _flow(master)
    yield f"  - {_flow(keys)}"


def _master(each: FoundDescription, device: EsiDevice) -> Iterator[tuple[str, str]]:
    """Yield what the master has to do in another way than the description says."""
    if device.revision != each.slave.revision and device.revision_rule is None:
        yield "revision_rule", RevisionRule.SAME_LOW_AT_LEAST.value
    try:
        plan = plan_device(device, each.modules or None)
    except ValueError:
        return
    usual = {number: [pdo.index for pdo in pdos] for number, pdos in plan.assignment.items()}
    known = {pdo.index for pdo in plan.device.pdos}
    there = {
        channel.number: [pdo.index for pdo in channel.pdos]
        for channel in each.channels
        if channel.number in usual
    }
    other = {number: pdos for number, pdos in there.items() if pdos != usual[number]}
    if other and all(known.issuperset(pdos) for pdos in other.values()):
        pdos = (
            f'"{number}": [{", ".join(f"0x{index:04X}" for index in indexes)}]'
            for number, indexes in sorted(other.items())
        )
        yield "pdos", f"{{{', '.join(pdos)}}}"


def _from_eeprom(each: FoundDescription, wiring: Mapping[str, str]) -> Iterator[str]:
    slave, fixed = each.slave, each.content.fixed
    keys = {
        "kind": "generic",
        "vendor": f"0x{slave.vendor:08X}",
        "product": f"0x{slave.product:08X}",
        "revision": f"0x{slave.revision:08X}",
        **_alias(each),
        **wiring,
        "mailbox": _mailbox(each.content),
    }
    if not each.has_clock:
        keys["clock"] = "null"
    if not fixed.boot_receive_size:
        keys["boot"] = "false"
    yield f"  - name: {_scalar(each.name)}"
    for key, value in keys.items():
        yield f"    {key}: {value}"
    names: dict[int, str] = {}
    for key, is_output in (("inputs", False), ("outputs", True)):
        pdos = [p for c in each.channels if c.is_output is is_output for p in c.pdos]
        unusable = [pdo for pdo in pdos if pdo.index not in _RANGES[not is_output]]
        for pdo in unusable:
            yield f"    # PDO 0x{pdo.index:04X} needs the ESI file of the vendor"
        usable = [pdo for pdo in pdos if pdo not in unusable and pdo.entries]
        texts = _pdo_names(each.content)
        if len(usable) > 1 or any(texts.get(pdo.index) not in _PLAIN_NAMES for pdo in usable):
            names |= {pdo.index: texts[pdo.index] for pdo in usable if texts.get(pdo.index)}
        if usable:
            yield f"    {key}:"
            yield from (f"      - {line}" for pdo in usable for line in _entries(pdo, is_output))
    if names:
        pairs = {f'"0x{index:04X}"': _scalar(name) for index, name in names.items()}
        yield f"    pdo_names: {_flow(pairs)}"


def _pdo_names(content: Sii) -> dict[int, str]:
    return {
        pdo.header.index: content.string(pdo.header.name)
        for pdo in (*content.rx_pdos, *content.tx_pdos)
    }


def _entries(pdo: Pdo, is_output: bool) -> Iterator[str]:
    for entry in pdo.entries:
        keys = {"name": json.dumps(entry.name, ensure_ascii=False) if entry.index else '""'}
        if entry.index:
            keys["name"] = _scalar(entry.name or f"{entry.index:04X}_{entry.subindex:02X}")
            keys["type"] = _scalar(_type(entry, is_output=is_output))
            keys["object"] = f'"0x{entry.index:04X}:{entry.subindex:02X}"'
        else:
            keys["object"] = '"0"'
        keys["bits"] = str(entry.bit_length)
        keys["pdo"] = f"0x{pdo.index:04X}"
        yield _flow(keys)


def _type(entry: PdoEntry, *, is_output: bool) -> str:
    bits = entry.bit_length
    kind = data_type_of(
        ProcessVariable(0, "", is_output, 0, bits, entry.data_type, entry.index, entry.subindex)
    )
    return kind.text if kind is not None else f"BLOCK({(bits + 7) // 8})"


def _mailbox(content: Sii) -> str:
    fixed = content.fixed
    if not fixed.receive_size:
        return "null"
    size = max(_MIN_MAILBOX, min(fixed.receive_size, _MAX_MAILBOX))
    served = {each.name: bool(fixed.protocols & each) for each in SiiProtocol if each.name}
    flags = {name.lower(): str(there).lower() for name, there in served.items()}
    return _flow({"size": str(size), **flags})


def _alias(each: FoundDescription) -> dict[str, str]:
    return {"alias": str(each.slave.alias)} if each.slave.alias else {}


def _path(file: Path, folder: Path) -> str:
    """Return the path of *file* from *folder* on if it is below it, else the absolute one."""
    whole, base = file.resolve(), folder.resolve()
    return str(whole.relative_to(base) if whole.is_relative_to(base) else whole)


def _flow(keys: Mapping[str, str]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in keys.items()) + "}"


def _scalar(text: str) -> str:
    """Return *text* as YAML reads it back: quoted unless it is plainly a word."""
    if _WORD.fullmatch(text) and text.lower() not in _RESERVED:
        return text
    return json.dumps(text, ensure_ascii=False)
