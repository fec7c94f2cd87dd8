"""Check of a plant file or bus file: its errors, else warnings about what it says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
from msgspec import UNSET, UnsetType

from eap.config.document import kind_of, read
from eap.config.exposure import Exposure
from eap.config.finding import FindingReport, PlantFinding
from eap.config.load import Plant
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import fill
from eap.pd.device import DeviceFault
from eap.pd.spec import BusSlaveSpec, PortKind, StationSpec
from eap.runtime.plantfile import load_plant

if TYPE_CHECKING:
    from eap.runtime.busfile import BusFile


class CheckReport(msgspec.Struct, frozen=True):
    """``eapctl check``: all errors of a file, and its warnings if it has none."""

    ok: bool
    findings: tuple[PlantFinding, ...]
    warnings: tuple[PlantFinding, ...]
    security: tuple[Exposure, ...] | UnsetType = UNSET
    """Places that it leaves open to other hosts, where that was asked for."""


class CheckedPlant(NamedTuple):
    """Plant file; *plant* is None if it has errors."""

    report: CheckReport
    plant: Plant | None


class CheckedBus(NamedTuple):
    """Bus file; *bus* is None if it has errors."""

    report: CheckReport
    bus: BusFile | None


def check_file(path: Path, *, security: bool = False) -> CheckedPlant | CheckedBus:
    """Check a plant file or bus file; *security* also lists what a plant leaves open."""
    checked = check_plant(path, security=security)
    # Read again only if it is not a plant without errors: large plants take seconds to read.
    return checked if checked.report.ok or not _is_bus(path) else _check_bus(path)


def _is_bus(path: Path) -> bool:
    root = read(path, FindingReport(str(path)))
    return root is not None and kind_of(root) == "bus"


def _check_bus(path: Path) -> CheckedBus:
    from eap.runtime import busfile  # simulated devices

    result = busfile.load(path)
    return CheckedBus(
        CheckReport(not result.findings, result.findings, result.warnings), result.bus
    )


def check_plant(path: Path, *, security: bool = False) -> CheckedPlant:
    """Check the plant file at *path*; *security* also lists what it leaves open."""
    result = load_plant(path)
    if result.plant is None:
        return CheckedPlant(CheckReport(not result.findings, result.findings, ()), None)
    warnings = []
    for number, station in enumerate(result.plant.stations):
        place = f"stations[{number}]"
        for message, expected in (*_small_dictionaries(station), *_alike_slaves(station)):
            line = result.lines.get(place, 0)
            warnings.append(
                PlantFinding(str(path), line, place, f"station {station.name}, {message}", expected)
            )
    exposures = result.exposures if security else UNSET
    found = CheckReport(True, (), (*warnings, *result.warnings), exposures)
    return CheckedPlant(found, result.plant)


def _small_dictionaries(station: StationSpec) -> Iterator[tuple[str, str]]:
    for port, reason in _misfits(station):
        yield (
            f"port {port}: {reason}; the port runs, but cannot be changed at run time",
            "no more than an object dictionary holds",
        )


def _alike_slaves(station: StationSpec) -> Iterator[tuple[str, str]]:
    """Yield simulated slaves that have the identity of one before, but other process data."""
    for port in station.ports:
        if port.bus is None or port.interface.scheme != "sim":
            continue
        known: dict[tuple[int, int, int | None], BusSlaveSpec] = {}
        for slave in port.bus.slaves:
            first = known.setdefault((slave.vendor, slave.product, slave.revision), slave)
            if _process_data(first) != _process_data(slave):
                message = (
                    f"port {port.name}: {first.name} and {slave.name} have the same vendor,"
                    " product and revision, but other process data; masters such as SOEM take"
                    " them to be alike"
                )
                yield message, f"a product number of its own for {slave.name} in the bus file"


def _process_data(slave: BusSlaveSpec) -> list[list[tuple[int, int, int]]]:
    return [
        [(entry.index, entry.subindex, entry.bit_length) for entry in entries]
        for entries in (slave.outputs, slave.inputs)
    ]


def _misfits(station: StationSpec) -> list[tuple[str, str]]:
    """Return the EAP ports of *station* whose dictionary is too small, and why."""
    found = []
    for port in station.ports:
        if port.kind is PortKind.EAP:
            try:
                fill(EapDictionary(station, port.name))
            except DeviceFault as exc:
                found.append((port.name, exc.text))
    return found
