"""Warnings about a plant file without errors: too small dictionaries, slaves that look alike.

Warnings about routes come with the loaded file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from eap.config.finding import PlantFinding
from eap.config.load import Plant
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_fill import fill
from eap.ids import InterfaceUri
from eap.pd.device import DeviceFault
from eap.pd.spec import BusSlaveSpec, PortKind, StationSpec
from eap.runtime.plantfile import load_plant


class CheckReport(msgspec.Struct, frozen=True):
    """``eapctl check``: all errors of a plant file, and its warnings if it has none."""

    ok: bool
    findings: tuple[PlantFinding, ...]
    warnings: tuple[PlantFinding, ...]


def check_plant(path: Path) -> tuple[CheckReport, Plant | None]:
    """Load the plant file at *path*; return the findings, and the plant if it has no errors."""
    result = load_plant(path)
    if result.plant is None:
        return CheckReport(not result.findings, tuple(result.findings), ()), None
    warnings = []
    for number, station in enumerate(result.plant.stations):
        place = f"stations[{number}]"
        for message, expected in (*_small_dictionaries(station), *_alike_slaves(station)):
            line = result.lines.get(place, 0)
            warnings.append(
                PlantFinding(str(path), line, place, f"station {station.name}, {message}", expected)
            )
    return CheckReport(True, (), (*warnings, *result.warnings)), result.plant


def _small_dictionaries(station: StationSpec) -> Iterator[tuple[str, str]]:
    for port, reason in _misfits(station):
        yield (
            f"port {port}: {reason}; it runs, but cannot be changed while it does",
            "no more than an object dictionary holds",
        )


def _alike_slaves(station: StationSpec) -> Iterator[tuple[str, str]]:
    """Yield simulated slaves that have the identity of one before, but other process data."""
    for port in station.ports:
        if port.bus is None or InterfaceUri.parse(port.interface).scheme != "sim":
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
