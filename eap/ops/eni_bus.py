"""Bus file and device descriptions made of an ENI file.

The process data of a slave is described by the vendor's ESI file if there is one that agrees with
the ENI, else by an ESI file that is written of the ENI: both have PDO lists of the same form.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from devicebus.esi.choice import DeviceQuery, plan_device
from devicebus.esi.device import read_device
from devicebus.esi.fields import Fields
from devicebus.esi.records import EsiDevice, EsiPdoEntry
from eap.codec.soe import Idn
from eap.config.imports.eni_records import EniBus, EniSlave, EniVariable
from eap.config.imports.planttext import scalar
from eap.config.imports.records import ImportOutcome, ImportReport
from eap.config.imports.stations import UniqueNames
from eap.od.slave_config import ALIAS_REGISTER, US, IdnWrite, MappedObject, RevisionRule, SdoWrite
from eap.ops.eni_device import OwnDevice, pdo_bits, xml_text
from eap.pd.rules import plain_name
from eap.runtime.esi_files import EsiSource

_PORTS = {"B": 1, "C": 2, "D": 3}
_SYNC0, _SYNC1 = 0x0200, 0x0400


class BusFiles(msgspec.Struct, frozen=True):
    """A bus file and the ESI files that it names, by their names in one folder."""

    name: str
    has_clock: bool
    cycle_us: int
    """0 if the file does not say."""
    texts: dict[str, str]


class _BusSlave(msgspec.Struct, kw_only=True):
    """A slave of the bus file while it is put together."""

    eni: EniSlave
    name: str
    wiring: dict[str, str] = {}
    type: str = ""
    vendor_file: Path | None = None
    vendor_device: EsiDevice | None = None
    group: str = ""


class ImportedBusPlan:
    """The bus of an ENI file with the descriptions of its slaves.

    Args:
        eni: The bus.
        source: ESI files of vendors; None for none.
        report: Takes notes, and findings of descriptions that cannot be used.
    """

    def __init__(self, eni: EniBus, source: EsiSource | None, report: ImportReport) -> None:
        self._eni = eni
        self._source = source
        self._report = report
        self._variables = _by_slave(eni)
        names = UniqueNames()
        self._slaves = [
            _BusSlave(eni=each, name=names.take(plain_name(each.name, "slave")))
            for each in eni.slaves
        ]
        self._devices: dict[str, tuple[int, str, str]] = {}
        """Vendor, type and text of the descriptions, by their texts without a type."""
        for slave in self._slaves:
            self._describe(slave)
        self._wire()
        self._name_groups()
        for slave in self._slaves:
            self._note_taken(slave)

    @property
    def has_clock(self) -> bool:
        """True if clocks have to be set."""
        return any(each.has_clock for each in self._eni.slaves)

    def files(self, stem: str, folder: Path) -> BusFiles:
        """Return the files for *folder*; their names begin with *stem*."""
        vendors = sorted({vendor for vendor, _, _ in self._devices.values()})
        names = {
            vendor: f"{stem}-esi.xml" if len(vendors) == 1 else f"{stem}-esi-{vendor:X}.xml"
            for vendor in vendors
        }
        origin = " ".join(Path(self._eni.file).name.split())
        lines = [
            f"# Made of {origin} by 'eapctl import'.",
            f"bus: {scalar(plain_name(stem, 'bus'))}",
            "slaves:",
        ]
        for slave in self._slaves:
            lines += _slave_lines(slave, names, folder, self._eni.cycle_us)
        texts = {f"{stem}.yaml": "\n".join([*lines, ""])}
        for vendor, name in names.items():
            texts[name] = _esi_text(
                vendor, [text for owner, _, text in self._devices.values() if owner == vendor]
            )
        return BusFiles(f"{stem}.yaml", self.has_clock, self._eni.cycle_us, texts)

    def line_of(self, message: str) -> int:
        """Return the line of the slave that a finding about the bus file begins with, else 0."""
        name = message.partition(": ")[0]
        return next((each.eni.line for each in self._slaves if each.name == name), 0)

    def note_order(self, names: Sequence[str]) -> None:
        """Note the slaves whose place, or station address, is another one than in the ENI.

        Args:
            names: Slaves of the bus file in the order in which a frame comes to them.
        """
        places = {name: number for number, name in enumerate(names)}
        moved = [each for n, each in enumerate(self._slaves) if places[each.name] != n]
        if moved:
            message = "by PreviousPort a frame comes to the slaves in another order than the file's"
            self._note(moved[0], ImportOutcome.WARNING, message)
        for each in self._slaves:
            station = 1001 + places[each.name]
            if each.eni.address and each.eni.address != station:
                message = f"station address {each.eni.address}: this master gives it {station}"
                self._note(each, ImportOutcome.LEFT, message)

    def _note(self, slave: _BusSlave, outcome: ImportOutcome, message: str) -> None:
        self._report.note(self._eni.file, slave.eni.line, slave.eni.name, outcome, message)

    def _describe(self, slave: _BusSlave) -> None:
        self._find_vendor(slave)
        if slave.vendor_device is not None:
            slave.type = slave.vendor_device.type
            return
        eni = slave.eni
        for number in sorted(eni.assigns.keys() - eni.managers.keys()):
            if eni.assigns[number]:
                message = f"PDOs of sync manager {number}, which the file does not describe"
                self._note(slave, ImportOutcome.LEFT, f"{message}: give its ESI file (--esi)")
        device = OwnDevice(eni, self._variables.get(eni.name, []), self._report, self._eni.file)
        element = device.element()
        fields = Fields()
        read_device(element, eni.vendor, "", fields)
        for each in fields.findings:
            line = each.line or eni.line
            self._report.add(self._eni.file, line, each.message, each.expected, item=eni.name)
        base = plain_name(eni.type, "") or f"P{eni.product:08X}"
        body = xml_text(element)
        key = f"{eni.vendor} {base} {body}"
        if key not in self._devices:
            same = [kind for _, kind, _ in self._devices.values() if kind.partition("/")[0] == base]
            kind = f"{base}/{len(same) + 1}" if same else base
            element.children[0].text = kind
            self._devices[key] = eni.vendor, kind, xml_text(element)
        slave.type = self._devices[key][1]

    def _find_vendor(self, slave: _BusSlave) -> None:
        """Take the vendor's description if it agrees with the ENI."""
        if self._source is None:
            return
        eni = slave.eni
        found = self._source.match(DeviceQuery(eni.vendor, eni.product, "", eni.revision))
        if found is None:
            message = f"no ESI file describes product 0x{eni.product:08X} of this revision"
            self._note(slave, ImportOutcome.WARNING, f"{message}: described by the ENI file")
            return
        device, file = found.device, found.located.file
        if device is None:
            why = f"it has faults: {found.findings[0].message}"
        else:
            why = _disagreement(eni, device)
            if not why:
                slave.vendor_device, slave.vendor_file = device, file
                return
        message = f"described by the ENI file, not by {file.name}: {why}"
        self._note(slave, ImportOutcome.WARNING, message)

    def _wire(self) -> None:
        places = {each.eni.address: n for n, each in enumerate(self._slaves) if each.eni.address}
        taken: set[tuple[int, int]] = set()
        for number, slave in enumerate(self._slaves[1:], 1):
            parent, port = number - 1, 1
            if slave.eni.previous is not None:
                letter, address = slave.eni.previous
                known = places.get(address, number)
                if known < number and letter in _PORTS and (known, _PORTS[letter]) not in taken:
                    parent, port = known, _PORTS[letter]
                else:
                    message = (
                        f"PreviousPort {letter} of {address} cannot be its place: put behind"
                        f" {self._slaves[parent].name}"
                    )
                    self._note(slave, ImportOutcome.WARNING, message)
            taken.add((parent, port))
            if parent != number - 1:
                slave.wiring["after"] = scalar(self._slaves[parent].name)
            if port != 1:
                slave.wiring["port"] = str(port)

    def _name_groups(self) -> None:
        names = UniqueNames()
        for number, slave in enumerate(self._slaves):
            if not slave.eni.group:
                continue
            name = names.take(plain_name(slave.eni.group, "group"))
            for each in self._slaves[number : number + slave.eni.members]:
                each.group = name
            if slave.eni.identification is None:
                message = f"hot-connect group {name} without a known identification: by its place"
                self._note(slave, ImportOutcome.WARNING, message)

    def _note_taken(self, slave: _BusSlave) -> None:
        eni = slave.eni
        parts = [f"kind {slave.type or 'esi'}"]
        if slave.vendor_file is not None:
            parts = [f"{slave.type} of {slave.vendor_file.name}"]
        pdos = [pdo for each in eni.managers.values() for pdo in each.pdos or ()]
        if pdos:
            parts.append(f"{len(pdos)} PDOs")
        if eni.writes:
            parts.append(f"{len(eni.writes)} start-up writes")
        if eni.sync is not None and eni.sync.activate != 0:
            parts.append("SYNC0")
        if slave.group:
            parts.append(f"hot-connect group {slave.group}")
        self._note(slave, ImportOutcome.TAKEN, ", ".join(parts))


def _by_slave(bus: EniBus) -> dict[str, list[EniVariable]]:
    """Return the variables of each slave: ``SLAVE.PDO.ENTRY``; a slave's name may have dots."""
    found: dict[str, list[EniVariable]] = {each.name: [] for each in bus.slaves}
    for each in bus.variables:
        for end, letter in enumerate(each.name):
            if letter == "." and each.name[:end] in found:
                found[each.name[:end]].append(each)
    return found


def _disagreement(eni: EniSlave, device: EsiDevice) -> str:
    """Return what the vendor's description lacks of the ENI; empty if they agree."""
    try:
        plan = plan_device(device)
    except ValueError as exc:
        return str(exc)
    known = {pdo.index: pdo for pdo in plan.device.pdos}
    coe = plan.coe
    for number, manager in eni.managers.items():
        if manager.pdos is None or manager.is_mailbox:
            continue
        for index in manager.pdos:
            if index not in known:
                return f"it has no PDO 0x{index:04X}"
        if manager.pdos and number >= len(device.sync_managers):
            return f"it has no sync manager {number}"
    own = {index: bits for index, bits in map(pdo_bits, eni.pdos) if index in known}
    for index, entries in eni.mapping.items():
        if index in known and entries != _mapping_of(known[index].entries):
            if known[index].is_fixed or coe is None or not coe.pdo_config:
                return f"the entries of PDO 0x{index:04X} are fixed and differ"
            own.pop(index, None)
    wrong = next((index for index, bits in own.items() if known[index].bits != bits), None)
    return "" if wrong is None else f"its PDO 0x{wrong:04X} has {known[wrong].bits} bits"


def _mapping_of(entries: Iterable[EsiPdoEntry]) -> tuple[MappedObject, ...]:
    return tuple(MappedObject(each.index, each.subindex, each.bits) for each in entries)


def _esi_text(vendor: int, devices: Iterable[str]) -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        "<!-- Made by 'eapctl import' of an ENI file: devices as that file configures them. -->\n"
        f"<EtherCATInfo>\n  <Vendor><Id>#x{vendor:08X}</Id></Vendor>\n"
        f"  <Descriptions>\n    <Devices>\n{''.join(devices)}    </Devices>\n"
        "  </Descriptions>\n</EtherCATInfo>\n"
    )


def _slave_lines(
    slave: _BusSlave, names: Mapping[int, str], folder: Path, cycle_us: int
) -> Iterator[str]:
    eni, device = slave.eni, slave.vendor_device
    file = names.get(eni.vendor, "")
    revision = eni.revision
    if device is not None and slave.vendor_file is not None:
        whole, base = slave.vendor_file.resolve(), folder.resolve()
        file = str(whole.relative_to(base) if whole.is_relative_to(base) else whole)
        revision = device.revision
    keys = {
        "kind": "esi",
        "esi": json.dumps(file, ensure_ascii=False),
        "device": scalar(slave.type),
        "product": f"0x{eni.product:08X}",
        "revision": f"0x{revision:08X}",
        **({"serial": str(eni.serial)} if eni.serial else {}),
        **slave.wiring,
    }
    yield f"  - name: {scalar(slave.name)}"
    for key, value in keys.items():
        yield f"    {key}: {value}"
    yield from (f"    # {text}" for text in eni.refused)
    master = list(_master_lines(slave, cycle_us))
    if master:
        yield "    master:"
        yield from (f"      {line}" for line in master)


def _master_lines(slave: _BusSlave, cycle_us: int) -> Iterator[str]:
    eni = slave.eni
    if eni.any_revision:
        yield f"revision_rule: {RevisionRule.ANY.value}"
    elif slave.vendor_device is not None and slave.vendor_device.revision != eni.revision:
        yield f"revision_rule: {RevisionRule.SAME_LOW_AT_LEAST.value}"
    if slave.group:
        yield f"group: {scalar(slave.group)}"
        if eni.identification is not None and eni.group:
            register, value = eni.identification
            yield f"alias: {value}"
            yield f"identification: {'alias' if register == ALIAS_REGISTER else 'id'}"
    if pdos := _assignment(slave):
        lists = (
            f'"{number}": [{", ".join(f"0x{index:04X}" for index in indexes)}]'
            for number, indexes in pdos.items()
        )
        yield f"pdos: {{{', '.join(lists)}}}"
    if eni.mapping:
        yield "mapping:"
        for index, entries in eni.mapping.items():
            texts = (
                f'"0x{each.index:04X}:{each.subindex:02X}/{each.bit_length}"'
                if each.index
                else f'"0/{each.bit_length}"'
                for each in entries
            )
            yield f'  "0x{index:04X}": [{", ".join(texts)}]'
    if eni.writes:
        yield "startup:"
        yield from (f"  - {_write(each)}" for each in eni.writes)
    yield from _sync_lines(slave, cycle_us)
    if eni.timeouts:
        yield f"timeouts: {{{', '.join(f'{key}: {value}' for key, value in eni.timeouts.items())}}}"


def _assignment(slave: _BusSlave) -> dict[int, tuple[int, ...]]:
    """Return the PDOs that are not those of the vendor's description by default."""
    if slave.vendor_device is None:
        return {}
    plan = plan_device(slave.vendor_device)
    usual = {number: tuple(pdo.index for pdo in pdos) for number, pdos in plan.assignment.items()}
    wanted = dict(slave.eni.assigns)
    for number, manager in slave.eni.managers.items():
        if not manager.is_mailbox and manager.pdos is not None:
            wanted[number] = manager.pdos
    return {
        number: pdos
        for number, pdos in sorted(wanted.items())
        if number in usual and pdos != usual[number]
    }


def _write(each: SdoWrite | IdnWrite) -> str:
    at = ", ".join(each.at)
    keys = {"transition": at if len(each.at) == 1 else f"[{at}]"}
    if isinstance(each, SdoWrite):
        keys["sdo"] = f'"0x{each.index:04X}:{each.subindex:02X}"'
        if each.complete:
            keys["complete"] = "true"
    else:
        keys["idn"] = str(Idn.of(each.idn))
        if each.drive:
            keys["drive"] = str(each.drive)
    keys["data"] = json.dumps(each.data.hex(" "))
    if each.comment:
        keys["comment"] = json.dumps(each.comment, ensure_ascii=False)
    return f"{{{', '.join(f'{key}: {value}' for key, value in keys.items())}}}"


def _sync_lines(slave: _BusSlave, cycle_us: int) -> Iterator[str]:
    sync, device = slave.eni.sync, slave.vendor_device
    if sync is None or sync.activate == 0 or not (sync.activate or 0x200) & _SYNC0:
        if (
            device is not None
            and not slave.eni.by_vendor
            and any(each.mode.activate for each in device.op_modes)
        ):
            yield "activate: 0"
        return
    cycle = sync.cycle0_ns / US
    keys = {}
    if cycle and cycle != cycle_us:
        keys["cycle_us"] = f"{round(cycle)}"
    keys["shift_us"] = f"{sync.shift_ns / US:g}"
    yield f"sync0: {{{', '.join(f'{key}: {value}' for key, value in keys.items())}}}"
    if (sync.activate or 0) & _SYNC1 or (sync.activate is None and sync.cycle1_ns):
        # The register has the time from SYNC0 to SYNC1, which is the shift here.
        yield f"sync1: {{shift_us: {sync.cycle1_ns / US:g}}}"
    if sync.activate is not None:
        yield f"activate: 0x{sync.activate:04X}"
