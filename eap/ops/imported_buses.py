"""Buses of imported ENI and ESI files: their files, and the ports of a plant file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from devicebus.esi.choice import DeviceQuery
from eap.config.imports.eni_records import EniBus, EniSlave
from eap.config.imports.records import ImportReport
from eap.config.imports.stations import (
    DEFAULT_CYCLE_US,
    MAX_CYCLE_US,
    MIN_CYCLE_US,
    PlannedPort,
    PlannedStation,
    UniqueNames,
    made_up_net_id,
)
from eap.errors import ConfigError
from eap.ids import InterfaceUri, NetId
from eap.ops.eni_bus import BusFiles, ImportedBusPlan
from eap.pd.rules import plain_name
from eap.runtime.busfile import describe
from eap.runtime.durable import whole_file
from eap.runtime.esi_files import EsiSource
from eap.runtime.plantfile import load_plant

NUMBER = "{n}"
SIMULATED = "sim"
MAX_DEVICES = 64
"""Devices of ESI files that become a bus without being named."""


def vendor_files(path: Path | None) -> EsiSource | None:
    """Return the ESI files at *path*; raise ConfigError if they cannot be read."""
    try:
        return None if path is None else EsiSource(path)
    except OSError as exc:
        raise ConfigError(f"--esi {path}: {exc.strerror or exc}") from None


def bus_of_devices(path: Path, types: Sequence[str], report: ImportReport) -> EniBus | None:
    """Return a bus of the devices of an ESI file or folder; None with findings."""
    try:
        source = EsiSource(path)
    except OSError as exc:
        report.add(str(path), 0, f"cannot be read: {exc.strerror or exc}", "ESI files")
        return None
    chosen = types or list(dict.fromkeys(each.listed.type for each in source.devices))
    if not chosen:
        report.findings += [*source.findings(), source.no_device]
    elif len(chosen) > MAX_DEVICES:
        message = f"it describes {len(chosen)} devices"
        report.add(str(path), 0, message, "those of the bus: --device TYPE for each")
        return None
    slaves = []
    for name in chosen:
        try:
            found = source.choose(DeviceQuery(type=name))
        except ValueError as exc:
            report.add(str(path), 0, str(exc), "a type of its devices (--device)")
            continue
        report.findings += found.findings if found.device is None else ()
        listed = found.located.listed
        slaves.append(
            EniSlave(
                name=listed.type,
                line=listed.line,
                address=0,
                vendor=listed.vendor,
                product=listed.product,
                revision=listed.revision,
                type=listed.type,
                by_vendor=True,
            )
        )
    return None if report.findings else EniBus(file=str(path), slaves=tuple(slaves))


def plan_buses(
    buses: Sequence[tuple[EniBus, EsiSource | None]], folder: Path, report: ImportReport
) -> Iterator[BusFiles]:
    """Yield the files of each bus, which have been tried; what is wrong goes to *report*."""
    taken: set[str] = set()
    for bus, source in buses:
        plan = ImportedBusPlan(bus, source, report)
        if report.findings:
            continue
        with TemporaryDirectory() as name:
            trial = plan.files("bus", Path(name))
            for file, text in trial.texts.items():
                (Path(name) / file).write_text(text, encoding="utf-8")
            described = describe(Path(name) / trial.name)
        if isinstance(described, tuple):
            for each in described:
                report.add(bus.file, plan.line_of(each.message), each.message, each.expected)
            continue
        plan.note_order([each.name for each in described.slaves])
        stem = plain_name(f"{Path(bus.file).stem}-bus", "bus")
        numbers = (f"{stem}{'' if n == 1 else f'-{n}'}" for n in itertools.count(1))
        files = (plan.files(each, folder) for each in numbers)
        free = next(
            each
            for each in files
            if not any(file in taken or (folder / file).exists() for file in each.texts)
        )
        taken |= set(free.texts)
        yield free


def with_buses(
    stations: Sequence[PlannedStation],
    buses: Sequence[BusFiles],
    pattern: str,
    target: Path | None,
    *,
    is_first: bool,
    cycle_us: int,
) -> list[PlannedStation]:
    """Return *stations* with a port for each bus.

    Args:
        stations: The imported ones.
        buses: Files of the buses.
        pattern: Interfaces of the ports, or SIMULATED.
        target: Plant file that they are added to if it exists.
        is_first: The ports are those of the first station, else of one that is made.
        cycle_us: Cycle of that one; 0 for the shortest of the buses.

    Raises:
        ConfigError: *pattern* is invalid.
    """
    if not is_first:
        stations = [*stations, _bus_station(buses, stations, cycle_us, target)]
    owner = stations[0 if is_first else -1]
    first = len(owner.ports)
    ports = tuple(
        PlannedPort(
            name=f"bus{number}",
            interface=_interface(pattern, number + 1, each.name),
            net_id=NetId(bytes(owner.net_id[:4]) + bytes((2 + first + number, 1))),
            bus=each.name,
            clocks=each.has_clock,
        )
        for number, each in enumerate(buses)
    )
    changed = msgspec.structs.replace(owner, ports=(*owner.ports, *ports))
    return [changed if each is owner else each for each in stations]


def _interface(pattern: str, number: int, file: str) -> str:
    if pattern == SIMULATED:
        return f"{SIMULATED}://{file}"
    try:
        return str(InterfaceUri.parse(pattern.replace(NUMBER, str(number))))
    except ValueError as exc:
        raise ConfigError(f"bus {pattern!r}: {exc}") from None


def _bus_station(
    buses: Sequence[BusFiles], others: Sequence[PlannedStation], cycle_us: int, target: Path | None
) -> PlannedStation:
    """Return a station without ports, with a name and a NetID that no other has."""
    before = load_plant(target).plant if target is not None and target.exists() else None
    known = [(each.name, each.net_id) for each in others]
    known += [(each.name, each.net_id) for each in before.stations] if before else []
    base = made_up_net_id(None)
    free = (NetId(bytes(base[:3]) + bytes((last,)) + b"\1\1") for last in range(base[3], 255))
    taken = {bytes(net_id[:4]) for _, net_id in known}
    cycles = [each.cycle_us for each in buses if each.cycle_us]
    cycle_us = cycle_us or min(cycles, default=DEFAULT_CYCLE_US)
    return PlannedStation(
        name=UniqueNames(name for name, _ in known).take("master"),
        net_id=next((each for each in free if bytes(each[:4]) not in taken), base),
        cycle_us=max(MIN_CYCLE_US, min(cycle_us, MAX_CYCLE_US)),
        remarks=("The NetID is made up: an ENI file has none.",),
    )


@contextmanager
def written_files(buses: Sequence[BusFiles], folder: Path) -> Iterator[list[Path]]:
    """Write the files of *buses*; those that are still in the list at the end are removed."""
    written: list[Path] = []
    try:
        for each in buses:
            for name, text in each.texts.items():
                with whole_file(folder / name) as file:
                    file.write(text.encode())
                written.append(folder / name)
        yield written
    finally:
        for path in written:
            path.unlink(missing_ok=True)
