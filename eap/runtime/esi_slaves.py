"""Slaves of bus files with descriptions of their vendors, for the simulator and for masters."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from devicebus.esi.choice import DeviceQuery, EsiPlan, default_config, manager_for, plan_device
from devicebus.esi.names import ProcessEntry, process_entries
from devicebus.esi.objects import type_of
from devicebus.esi.records import EsiDevice, EsiPdo
from devicebus.sim.spec import DEFAULT_VENDOR, SlaveSpec
from eap.codec import datatypes
from eap.config.finding import FindingReport
from eap.config.index import DescribedPdo, DescribedPdoEntry, DescribedSlave
from eap.runtime.esi_files import EsiSource

_FILE = "an ESI file or a folder of ESI files, its path from the bus file on"
_NAMED = "the key device or product to name one of its devices"


class EsiDevices:
    """Devices of the slaves of one bus file; files and folders are read once.

    Args:
        folder: Folder of the bus file.
        report: Takes the findings.
    """

    def __init__(self, folder: Path, report: FindingReport) -> None:
        self._folder = folder
        self._report = report
        self._sources: dict[str, EsiSource | None] = {}

    def find(self, spec: SlaveSpec, name: str, at: str) -> EsiDevice | None:
        """Return the device of a slave from the file or folder *name*; None after a finding."""
        if not name:
            self._report.add(
                at, f"{spec.name}: kind esi without a description", f"key esi: {_FILE}"
            )
            return None
        source = self._source(name, at)
        if source is None:
            return None
        vendor = 0 if spec.vendor == DEFAULT_VENDOR else spec.vendor
        query = DeviceQuery(vendor, spec.product, spec.device, spec.revision)
        if source.is_folder and not (spec.product or spec.device):
            self._report.add(at, f"{spec.name}: {name} is a folder", _NAMED)
            return None
        try:
            found = source.choose(query)
        except ValueError as exc:
            self._report.add(at, f"{spec.name}: {exc}", _NAMED)
            return None
        if found.device is None:
            listed, count = found.located.listed, len(found.findings)
            faults = "1 fault" if count == 1 else f"{count} faults"
            message = f"{spec.name}: {listed.type} cannot be used: {faults} in its file"
            self._report.add(at, message, "a description without faults")
            self._report.adopt(found.findings)
        return found.device

    def _source(self, name: str, at: str) -> EsiSource | None:
        if name in self._sources:
            return self._sources[name]
        source = None
        try:
            source = EsiSource(self._folder / name)
        except (OSError, ValueError) as exc:
            reason = getattr(exc, "strerror", None) or exc
            self._report.add(at, f"{name} cannot be read: {reason}", _FILE)
        else:
            # In a folder the faults of other files do no harm.
            if not source.is_folder and not source.devices:
                self._report.adopt(source.findings())
        self._sources[name] = source
        return source


def describe_device(spec: SlaveSpec, device: EsiDevice) -> DescribedSlave:
    """Return a slave as its vendor describes it, with the configuration by default.

    Raises:
        ValueError: a module of *spec* does not fit.
    """
    plan = plan_device(device, spec.modules)
    whole = plan.device
    # A designation in the place of the type has the revision, too.
    is_type = spec.device.casefold() in {"", whole.type.casefold()}
    pdos = tuple(_pdos(plan))
    mailbox = whole.mailbox
    return DescribedSlave(
        name=spec.name,
        vendor=whole.vendor,
        product=whole.product,
        revision=spec.revision if is_type else whole.revision,
        serial=spec.serial or None,
        alias=spec.alias or None,
        outputs=tuple(_assigned(plan, is_output=True)),
        inputs=tuple(_assigned(plan, is_output=False)),
        config=default_config(plan),
        pdos=pdos,
        objects=tuple(_objects(whole)),
        op_modes=tuple(each.mode for each in whole.op_modes),
        assignments=_assignments(whole),
        managers={
            number: each.is_output
            for number, each in enumerate(whole.sync_managers)
            if not each.is_mailbox
        },
        has_coe=plan.coe is not None,
        has_soe=mailbox is not None and bool(mailbox.soe_channels),
        has_clock=whole.has_dc,
    )


def _assignments(device: EsiDevice) -> dict[str, dict[int, tuple[int, ...]]]:
    """Return the named PDO assignments of a device that it can have."""
    known = {pdo.index for pdo in device.pdos}
    return {
        each.name: dict(each.sync_managers)
        for each in device.alternatives
        if each.name and known.issuperset(i for _, pdos in each.sync_managers for i in pdos)
    }


def _pdos(plan: EsiPlan) -> Iterator[DescribedPdo]:
    assigned = {pdo.index: n for n, pdos in plan.assignment.items() for pdo in pdos}
    order = [pdo for pdos in plan.assignment.values() for pdo in pdos]
    order += [pdo for pdo in plan.device.pdos if pdo.index not in assigned]
    for pdo in order:
        manager = assigned.get(pdo.index, manager_for(plan.device, pdo))
        if manager is None:
            continue
        yield DescribedPdo(
            index=pdo.index,
            name=pdo.name,
            group=pdo.name,
            is_output=pdo.is_output,
            manager=manager,
            assigned=pdo.index in assigned,
            mandatory=pdo.is_mandatory,
            fixed=plan.has_fixed_mapping(pdo),
            excludes=pdo.excludes,
            entries=tuple(_entries(pdo, manager)),
        )


def _assigned(plan: EsiPlan, *, is_output: bool) -> Iterator[DescribedPdoEntry]:
    for manager, pdos in sorted(plan.assignment.items()):
        for pdo in pdos:
            if pdo.is_output is is_output:
                yield from _entries(pdo, manager)


def _entries(pdo: EsiPdo, manager: int) -> Iterator[DescribedPdoEntry]:
    for entry in process_entries([pdo]):
        yield _entry(entry, manager)


def _entry(entry: ProcessEntry, manager: int) -> DescribedPdoEntry:
    if not entry.index:
        return DescribedPdoEntry("", "", 0, 0, entry.bits, manager, entry.pdo_name)
    kind = datatypes.parse(type_of(entry.type, entry.bits))
    place = entry.index, entry.subindex, entry.bits
    return DescribedPdoEntry(entry.name, kind.text, *place, manager, entry.pdo_name)


_FIRST_APPLICATION_OBJECT = 0x2000


def _objects(device: EsiDevice) -> Iterator[DescribedPdoEntry]:
    """Yield the entries of the application."""
    for item in device.objects:
        if item.index < _FIRST_APPLICATION_OBJECT:
            continue
        for entry in item.entries:
            kind = datatypes.parse(entry.type)
            place = item.index, entry.subindex, kind.bit_length
            yield DescribedPdoEntry(entry.name, kind.text, *place, access=entry.access)
