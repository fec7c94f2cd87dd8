"""Bus files: a simulated segment in YAML, checked as a whole like a plant file.

The cores read no files, so this module reads the files that a bus file refers to: values in CSV,
which it hands over as bytes, and device descriptions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
from msgspec.structs import replace

from devicebus.esi.records import EsiDevice
from devicebus.master.pdo import PdoEntry, channels_from_sii
from devicebus.sim.devices.build import build_segment, build_slave
from devicebus.sim.fault import FaultySegment
from devicebus.sim.segment import SegmentEnd, trace_path
from devicebus.sim.spec import BusSpec, DeviceKind, SlaveSpec
from devicebus.wire import sii
from devicebus.wire.sii import Sii, SiiProtocol
from eap.config.document import convert_to, read
from eap.config.finding import FindingReport, PlantFinding, one_of
from eap.config.index import DescribedPdo, DescribedPdoEntry, DescribedSlave, ExpectedBus
from eap.config.slaves import configure
from eap.config.structs import SlaveSection
from eap.errors import ConfigError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import ObjectCode
from eap.runtime.durable import digest
from eap.runtime.esi_slaves import EsiDevices, describe_device
from eap.suggest import suggest

MAX_RESOURCE = 16 << 20
"""Bytes of the largest file that a bus file may refer to."""


class BusFileSlave(SlaveSpec, frozen=True, kw_only=True):
    """Slave of a bus file: what the simulator plays, and what a master configures."""

    master: SlaveSection = SlaveSection()


class BusFileSpec(BusSpec, frozen=True, kw_only=True):
    """Content of a bus file."""

    slaves: tuple[BusFileSlave, ...]


class BusFile(msgspec.Struct, frozen=True):
    """A bus file that can be built, with the files it refers to by the names it uses."""

    spec: BusFileSpec
    resources: dict[str, bytes]
    devices: dict[str, EsiDevice]
    """Vendors' descriptions of the slaves of kind esi, by their names."""

    def digest(self) -> str:
        """Return the digest of what is simulated, without paths and the settings of a master."""
        slaves = tuple(replace(slave, esi="", master=SlaveSection()) for slave in self.spec.slaves)
        spec = replace(self.spec, bus="", esi="", slaves=slaves)
        return digest(msgspec.msgpack.encode(replace(self, spec=spec)))

    def build(self) -> FaultySegment:
        """Make the segment with the script of its faults."""
        return FaultySegment(
            build_segment(self.spec, self.resources, self.devices), self.spec.faults
        )


class BusResult(msgspec.Struct, frozen=True):
    """Either a bus and no findings, or no bus and all findings in the order of the file."""

    bus: BusFile | None
    findings: tuple[PlantFinding, ...]
    warnings: tuple[PlantFinding, ...] = ()
    """Warnings about a bus that is valid."""


def load(path: Path) -> BusResult:
    """Read and check the bus file at *path*; never raises for what the file holds."""
    report = FindingReport(str(path))
    root = read(path, report)
    spec = None if root is None else convert_to(BusFileSpec, root, report, "bus")
    if spec is None or report.findings():
        return BusResult(None, report.findings())
    bus = BusFile(spec, {}, {})
    devices = EsiDevices(path.parent, report)
    for number, slave in enumerate(spec.slaves):
        at = f"slaves[{number}]"
        for name in _files(slave):
            _read_resource(bus, path.parent / name, name, report, at)
        if slave.kind is DeviceKind.ESI:
            device = devices.find(slave, slave.esi or spec.esi, at)
            if device is not None:
                bus.devices[slave.name] = device
        _check_wiring(spec, number, report, at)
        if not report.findings():
            _check_slave(slave, bus, report, at)
        if not report.findings():
            configure(_describe(bus, number), slave.master, report)
    if not spec.slaves:
        report.add("slaves", "the bus has no slaves", "at least one slave")
    if not report.findings():
        _check_faults(bus, report)
    findings = report.findings()
    return BusResult(None, findings) if findings else BusResult(bus, (), tuple(report.warnings))


def load_or_raise(path: Path) -> BusFile:
    """Read the bus file at *path*; raise ConfigError with every finding if it is none."""
    result = load(path)
    if result.bus is None:
        raise ConfigError("\n".join(str(finding) for finding in result.findings))
    return result.bus


def describe(path: Path) -> ExpectedBus | tuple[PlantFinding, ...]:
    """Return the expected slaves of the bus file at *path*, or all findings about the file.

    That is what a master finds on such a bus.  What the file leaves open may be anything on a real
    one: revisions that it does not give, serial numbers and aliases that are 0.
    """
    result = load(path)
    if result.bus is None:
        return result.findings
    bus = result.bus
    report = FindingReport(str(path))  # of findings that are known to be absent
    return ExpectedBus(
        tuple(
            configure(_describe(bus, number), bus.spec.slaves[number].master, report)
            for number in _line(bus.spec)
        ),
        bus.spec.ring,
        bus.digest(),
        result.warnings,
    )


def _line(spec: BusSpec) -> tuple[int, ...]:
    """Return the slaves in the order in which a frame comes to them: branches change it."""
    links: dict[tuple[int, int], tuple[int, int] | SegmentEnd] = {(0, 0): SegmentEnd.PRIMARY}
    numbers = {slave.name: number for number, slave in enumerate(spec.slaves)}
    for number, slave in enumerate(spec.slaves[1:], 1):
        parent = numbers[slave.after] if slave.after else number - 1
        # Port 0 is the one that leads to the master.
        links[number, 0] = parent, slave.port
        links[parent, slave.port] = number, 0
    return trace_path(links, (0, 0)).order


def _describe(bus: BusFile, number: int) -> DescribedSlave:
    spec = bus.spec.slaves[number]
    if spec.name in bus.devices:
        return describe_device(spec, bus.devices[spec.name])
    slave = build_slave(spec, bus.resources)
    image = sii.decode(slave.esc.image)
    dictionary = slave.device.dictionary
    pdos = _describe_pdos(image, dictionary, spec.pdo_names)
    outputs, inputs = (
        tuple(
            entry
            for pdo in pdos
            if pdo.assigned and pdo.is_output is is_output
            for entry in pdo.entries
        )
        for is_output in (True, False)
    )
    return DescribedSlave(
        name=spec.name,
        vendor=image.fixed.vendor,
        product=image.fixed.product,
        revision=spec.revision,
        serial=image.fixed.serial or None,
        alias=image.fixed.alias or None,
        outputs=outputs,
        inputs=inputs,
        pdos=tuple(pdos),
        objects=tuple(_describe_objects(dictionary)),
        managers={each.number: each.is_output for each in channels_from_sii(image)},
        has_coe=bool(image.fixed.protocols & SiiProtocol.COE),
        has_soe=bool(image.fixed.protocols & SiiProtocol.SOE),
        has_clock=spec.clock is not None,
    )


def _describe_pdos(
    image: Sii, dictionary: ObjectDictionary, named: Mapping[str, str]
) -> list[DescribedPdo]:
    """Return the PDOs of an EEPROM in the order of their sync managers."""
    groups = {int(index, 16): name for index, name in named.items()}
    sides: dict[bool, list[int]] = {True: [], False: []}
    for channel in channels_from_sii(image):
        sides[channel.is_output].append(channel.number)
    found = []
    for is_output, pdos in ((True, image.rx_pdos), (False, image.tx_pdos)):
        managers = sides[is_output]
        for pdo in pdos if managers else ():
            # One that is not assigned by default (0xFF) goes to the first of its direction.
            assigned = pdo.header.sync_manager in managers
            manager = pdo.header.sync_manager if assigned else managers[0]
            entries = [
                _describe_entry(
                    PdoEntry(each.index, each.subindex, each.bit_length),
                    dictionary,
                    manager,
                    groups.get(pdo.header.index, ""),
                )
                for each in pdo.entries
            ]
            found.append(
                DescribedPdo(
                    index=pdo.header.index,
                    name=image.string(pdo.header.name),
                    group=groups.get(pdo.header.index, ""),
                    is_output=is_output,
                    manager=manager,
                    assigned=assigned,
                    entries=tuple(entries),
                )
            )
    return sorted(found, key=lambda each: each.manager)


def _describe_entry(
    entry: PdoEntry, dictionary: ObjectDictionary, manager: int, group: str
) -> DescribedPdoEntry:
    place = entry.index, entry.subindex, entry.bit_length
    if not entry.index:
        return DescribedPdoEntry("", "", *place, manager, group)
    known = dictionary.entry(entry.index, entry.subindex)
    return DescribedPdoEntry(known.name, known.kind.text, *place, manager, group)


_FIRST_APPLICATION_OBJECT = 0x2000


def _describe_objects(dictionary: ObjectDictionary) -> Iterator[DescribedPdoEntry]:
    """Yield the entries of the application, without the counts of records."""
    for item in dictionary:
        if item.index < _FIRST_APPLICATION_OBJECT:
            continue
        for subindex, entry in item.entries.items():
            if subindex or item.code is ObjectCode.VAR:
                kind = entry.kind
                place = item.index, subindex, kind.bit_length
                yield DescribedPdoEntry(entry.name, kind.text, *place, access=entry.access)


def _files(slave: SlaveSpec) -> Iterator[str]:
    for channel in slave.inputs:
        if channel.csv:
            yield channel.csv


def _read_resource(bus: BusFile, path: Path, name: str, report: FindingReport, at: str) -> None:
    try:
        with path.open("rb") as file:
            # Read with a limit, not measured first: a pipe or /proc file has no size.
            octets = file.read(MAX_RESOURCE + 1)
    except (OSError, ValueError) as exc:
        reason = getattr(exc, "strerror", None) or exc
        report.add(at, f"{name} cannot be read: {reason}", "a file beside the bus file")
        return
    if len(octets) > MAX_RESOURCE:
        report.add(at, f"{name} is too large", f"at most {MAX_RESOURCE >> 20} MiB")
    bus.resources[name] = octets


def _check_wiring(spec: BusSpec, number: int, report: FindingReport, at: str) -> None:
    slave = spec.slaves[number]
    before = {each.name: position for position, each in enumerate(spec.slaves[:number])}
    if slave.name in before:
        report.add(f"{at}.name", f"{slave.name!r} is there twice", "a name of its own")
    if not number:
        if slave.after:
            report.add(f"{at}.after", "the first slave is wired to the master", "no key after")
        return
    if slave.after and slave.after not in before:
        hint = suggest(slave.after, before)
        report.add(f"{at}.after", f"no slave {slave.after!r} before{hint}", one_of(before))
        return
    place = slave.after or spec.slaves[number - 1].name, slave.port
    for position, other in enumerate(spec.slaves[1:number], 1):
        taken = other.after or spec.slaves[position - 1].name, other.port
        if taken == place:
            message = f"port {slave.port} of {place[0]} has a cable to {other.name} already"
            report.add(at, message, "another port (key port, 1 to 3)")


def _check_slave(slave: SlaveSpec, bus: BusFile, report: FindingReport, at: str) -> None:
    for index in slave.pdo_names:
        try:
            int(index, 16)
        except ValueError:
            message = f"{slave.name}: {index!r} is no PDO"
            report.add(f"{at}.pdo_names", message, "an index such as 0x1A00")
            return
    try:
        build_slave(slave, bus.resources, bus.devices.get(slave.name))
    except ValueError as exc:
        report.add(at, f"{slave.name}: {exc}", "keys that fit the device")


def _check_faults(bus: BusFile, report: FindingReport) -> None:
    if not bus.spec.faults:
        return
    segment = FaultySegment(build_segment(bus.spec, bus.resources, bus.devices))
    for number, fault in enumerate(bus.spec.faults):
        try:
            segment.check(fault)
        except ValueError as exc:
            report.add(f"faults[{number}]", str(exc), "a fault that can happen")
