"""Import of files of other tools into a plant file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from ipaddress import IPv4Address
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory

import msgspec

from devicebus.esi.content import ROOT as ESI_ROOT
from eap.codec.xmlstream import CHUNK, XmlError, XmlReader
from eap.config.finding import PlantFinding
from eap.config.imports.eni import ROOT as ENI_ROOT
from eap.config.imports.eni import read_eni
from eap.config.imports.eni_records import EniBus
from eap.config.imports.insertion import InsertionError, insert_stations
from eap.config.imports.planttext import plant_text, station_lines
from eap.config.imports.records import ImportNote, ImportOutcome, ImportReport
from eap.config.imports.resolution import resolve, with_peers
from eap.config.imports.stations import (
    DEFAULT_CYCLE_US,
    ImportedSystem,
    PlannedPort,
    PlannedStation,
    PlannedVariable,
    PublisherIdentity,
    UniqueNames,
    made_up_net_id,
    plan_station,
)
from eap.config.imports.treeitems import ROOTS as TREE_ROOTS
from eap.config.imports.treeitems import TreeItem, assemble, read_tree_items
from eap.config.imports.twincat import ITEM, PROJECT, TwinCatProject, read_project
from eap.config.imports.typefile import ROOTS as TYPE_ROOTS
from eap.config.imports.typefile import TypeFile, TypeRecord, read_type_file
from eap.config.imports.typenames import TypeNames
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import NET_ID, InterfaceUri, NetId
from eap.ops.imported_buses import (
    NUMBER,
    bus_of_devices,
    plan_buses,
    vendor_files,
    with_buses,
    written_files,
)
from eap.pd.rules import NAME, is_name, plain_name, plant_name_of
from eap.runtime.durable import whole_file
from eap.runtime.esi_files import EsiSource
from eap.runtime.plantfile import load_plant

_DEFAULT_ADDRESS = "ethernet://line{n}"
"""An interface that no host has: nothing is sent before the user names one that exists."""
_EDC = (
    "EDC files have no public description, so none is read: export the publishers and subscribers"
    " of the EAP device as XML descriptions in TwinCAT (Export XML Description), or import the"
    " project itself"
)
_DEFAULT_BUS = "ethernet://bus{n}"
_ARCHIVE = "it is an archive: unpack it, and import the .tsproj file in it"
_SOLUTION = "it is a solution: import the .tsproj file in its folder"
_NOT_READ = {
    ".edc": _EDC,
    ".sln": _SOLUTION,
    ".tszip": _ARCHIVE,
    ".tnzip": _ARCHIVE,
    ".tpzip": _ARCHIVE,
}
_OTHER_ROOTS = {
    "TcConfig": ": 'eapctl routes import STATION FILE' takes the routes of it",
}
_VERSIONS = (
    "A project does not show the data type versions of its variables: 0, the default of TwinCAT 3,"
    " is assumed.  If PDs are dropped for their version, write it, or ignore_version: true."
)


class ImportChoices(msgspec.Struct, frozen=True, kw_only=True):
    """Options of an import.

    Attributes:
        plant: Name of the plant; empty for that of the file.
        address: Pattern of the interfaces of ports; ``{n}`` is the number of the port.
        identity: NetID that publishers send as their own.
        to: Destination of publishers whose file has none that can be used.
        cycle_us: Cycle of the imported stations; 0 for that of their tasks.
        peer: Name of a station that is made as the other side; empty for none.
        bus: Pattern of the interfaces of bus ports, or SIMULATED.
        esi: ESI file, or folder of ESI files, that describes slaves; None for none.
        devices: Types of the slaves of a bus that is made of ESI files; all if there are none.
    """

    plant: str = ""
    address: str = _DEFAULT_ADDRESS
    identity: PublisherIdentity = PublisherIdentity.DEVICE
    to: str = ""
    cycle_us: int = 0
    peer: str = ""
    bus: str = _DEFAULT_BUS
    esi: Path | None = None
    devices: tuple[str, ...] = ()


class ImportResult(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl import``.

    Attributes:
        ok: Everything could be read.
        file: The plant file that was written; empty if none was.
        plant: Name of the plant in it.
        added_to: Existing plant file that the stations were to be added to; empty for none.
        why_beside: Reason that another file than *added_to* was written; empty if it was that one.
        stations: Names of the stations.
        bus_files: Bus files, and ESI files that they name, as they are written with a plant file.
        notes: Outcome for each part of the files, with the reason.
        findings: Errors; nothing is written then.
    """

    ok: bool
    file: str = ""
    plant: str = ""
    added_to: str = ""
    why_beside: str = ""
    stations: tuple[str, ...] = ()
    bus_files: tuple[str, ...] = ()
    notes: tuple[ImportNote, ...] = ()
    findings: tuple[PlantFinding, ...] = ()


class _Sources(msgspec.Struct):
    """Content of the files of one import."""

    projects: list[TwinCatProject] = []
    types: list[tuple[str, TypeFile]] = []
    items: list[TreeItem] = []
    buses: list[tuple[EniBus, EsiSource | None]] = []


def run_import(
    files: Sequence[Path], target: Path | None, choices: ImportChoices
) -> tuple[ImportResult, str]:
    """Read *files* and write, or add to, the plant file *target*.

    Returns:
        The report, and the text of the plant file; empty if there is none.

    Raises:
        ConfigError: an option cannot be used.
        EnvironmentalError: the plant file cannot be written.
    """
    for kind, text in ("plant", choices.plant), ("station", choices.peer):
        if text and not is_name(text):
            raise ConfigError(f"{kind} name {text!r}: expected {NAME}")
    report = ImportReport()
    with ExitStack() as stack:
        # Without a plant file those of its buses are tried only.
        folder = target.parent if target else Path(stack.enter_context(TemporaryDirectory()))
        sources = _read(files, choices, report)
        stations, types = _plan(sources, choices, report)
        buses = list(plan_buses(sources.buses, folder, report))
        if buses and not report.findings:
            only = bool(stations) and (len(stations) == 1 or bool(choices.peer))
            stations = with_buses(
                stations, buses, choices.bus, target, is_first=only, cycle_us=choices.cycle_us
            )
        if report.findings or not stations:
            if not report.findings:
                expected = "an EAP device (DevType 112) that is enabled, symbols, or slaves"
                report.add(str(files[0]), 0, "nothing in it can be imported", expected)
            return _result(report), ""
        name = choices.plant or plant_name_of((target or files[0]).stem)
        head = [f"Made by 'eapctl import {' '.join(each.name for each in files)}'."]
        text = plant_text(name, stations, types, head=head)
        result = _result(report, name, stations)
        written = stack.enter_context(written_files(buses, folder))
        if target is not None and target.exists():
            result = _add(target, text, stations, types, result)
        else:
            place = Path(f"{name}.yaml") if target is None else target
            result = _checked(text, place, result, folder=folder if buses else None)
            if target is not None and result.ok:
                result = _written(target, text, result)
        if result.ok:
            result = msgspec.structs.replace(result, bus_files=tuple(map(str, written)))
            if target is not None:
                written.clear()
        return result, text


def _result(
    report: ImportReport, plant: str = "", stations: Sequence[PlannedStation] = ()
) -> ImportResult:
    notes = sorted(report.notes, key=lambda each: (each.file, each.line))
    return ImportResult(
        ok=not report.findings,
        plant=plant,
        stations=tuple(each.name for each in stations),
        notes=tuple(notes),
        findings=tuple(dict.fromkeys(report.findings)),
    )


def _read(files: Sequence[Path], choices: ImportChoices, report: ImportReport) -> _Sources:
    sources = _Sources()
    vendors = vendor_files(choices.esi)
    known: set[Path] = set()
    for path in files:
        file = str(path)
        if path.resolve() in known:
            report.add(file, 0, "it is named twice", "each file once")
            continue
        known.add(path.resolve())
        if reason := _NOT_READ.get(path.suffix.lower()):
            report.add(file, 0, reason, "a .tsproj, .xti, .tmc, .tpy, .xml or .eni file")
            continue
        root = ESI_ROOT if path.is_dir() else _root_of(path, report)
        if root == ESI_ROOT:
            made = bus_of_devices(path, choices.devices, report)
            sources.buses += [(made, EsiSource(path))] if made is not None else []
        elif root in {PROJECT, ITEM}:
            sources.projects.append(read_project(file, _chunks, report))
        elif root in TYPE_ROOTS:
            sources.types.append((file, read_type_file(_chunks(file), file, report)))
        elif root == ENI_ROOT:
            bus = read_eni(_chunks(file), file, report)
            sources.buses += [(bus, vendors)] if bus is not None else []
        elif root in TREE_ROOTS:
            sources.items += read_tree_items(_chunks(file), file, report)
        elif root:
            hint = _OTHER_ROOTS.get(root, "")
            expected = (
                "TcSmProject, TcSmItem, TcModuleClass, PlcProjectInfo, TreeItem, EtherCATConfig"
            )
            report.add(file, 1, f"it begins with {root!r}, which is not imported{hint}", expected)
    return sources


def _root_of(path: Path, report: ImportReport) -> str:
    """Return the name of the first element of a file; empty, with a finding, if there is none."""
    reader = XmlReader(())
    try:
        for chunk in _chunks(str(path)):
            reader.feed(chunk)
            if reader.root is not None:
                break
        else:
            reader.close()
    except XmlError as exc:
        # With a root, the reader of such files reports the error.
        if reader.root is None:
            report.add_error(str(path), exc)
    except OSError as exc:
        report.add(str(path), 0, f"cannot be read: {exc.strerror or exc}", "an XML file")
    return "" if reader.root is None else reader.root.tag


def _chunks(file: str) -> Iterator[bytes]:
    path = Path(file)
    # A pipe would block the reader, a device might never end.
    if path.is_dir():
        raise OSError("it is a folder")
    if path.exists() and not path.is_file():
        raise OSError("it is not a regular file")
    with path.open("rb") as opened:
        while chunk := opened.read(CHUNK):
            yield chunk


def _plan(
    sources: _Sources, choices: ImportChoices, report: ImportReport
) -> tuple[list[PlannedStation], list[str]]:
    """Return the stations, and the lines of the section of their types."""
    types = TypeNames(_records(sources), report)
    interfaces = _interfaces(choices.address)
    names = UniqueNames()
    stations = [
        plan_station(system, interfaces, choices.identity, choices.cycle_us, report)
        for system in _systems(sources, types, names, report)
    ]
    types.take_findings()
    # Without a port, as all devices are disabled, there is no station.
    stations = [each for each in stations if each.ports]
    if not sources.projects and not sources.items:
        stations = [
            station
            for file, found in sources.types
            if (station := _of_symbols(file, found, types, names, interfaces, choices, report))
        ]
    elif choices.peer and stations:
        stations = with_peers(stations, choices.peer, interfaces)
    return resolve(stations, choices.to, report), types.section()


def _records(sources: _Sources) -> Iterator[tuple[str, Sequence[TypeRecord]]]:
    for project in sources.projects:
        yield project.file, project.types
    for file, found in sources.types:
        yield file, found.types


def _systems(
    sources: _Sources, types: TypeNames, names: UniqueNames, report: ImportReport
) -> Iterator[ImportedSystem]:
    owners: dict[NetId, str] = {}
    for project in sources.projects:
        if project.devices:
            if project.net_id is not None:
                first = owners.setdefault(project.net_id, project.file)
                if first != project.file:
                    message = f"its NetID {project.net_id} is that of {first} too"
                    report.add(project.file, 0, message, "projects of different controllers")
            yield ImportedSystem(
                name=names.take(plain_name(Path(project.file).stem, "station")),
                net_id=project.net_id,
                devices=project.devices,
                cycles_us=project.cycles_us,
                type_text=types.text_of,
                remarks=(_VERSIONS,),
            )
    if devices := assemble(sources.items, report):
        files = {each.file for each in sources.items}
        title = Path(files.pop()).stem if len(files) == 1 else devices[0].name
        yield ImportedSystem(
            name=names.take(plain_name(title, "station")),
            net_id=None,
            devices=devices,
            cycles_us=tuple({each.cycle_us for each in devices if each.cycle_us}),
            type_text=types.text_of,
        )


def _of_symbols(
    file: str,
    found: TypeFile,
    types: TypeNames,
    names: UniqueNames,
    interfaces: Iterator[InterfaceUri],
    choices: ImportChoices,
    report: ImportReport,
) -> PlannedStation | None:
    """Return a station that has the symbols of a TMC or TPY file as variables."""
    net_id = made_up_net_id(uri := next(interfaces))
    if found.net_id:
        try:
            net_id = NetId.parse(found.net_id)
        except ValueError:
            report.add(file, 0, f"{found.net_id!r} is not an AMS NetID", NET_ID)
    has_areas = any(each.area for each in found.symbols)
    variables = []
    used: set[str] = set()
    for symbol in found.symbols:
        if has_areas and not symbol.area:
            continue
        kind = types.parse_if_usable(symbol)
        if symbol.name in used or not is_name(symbol.name):
            kind = "its name is used twice, or has spaces or slashes"
        used.add(symbol.name)
        if isinstance(kind, str):
            report.note(file, symbol.line, symbol.name, ImportOutcome.LEFT, kind)
            continue
        variables.append(PlannedVariable(symbol.name, kind.name, symbol.comment))
        report.note(file, symbol.line, symbol.name, ImportOutcome.TAKEN, f"variable {kind.name}")
    if not variables:
        return None
    port = PlannedPort(name="eap0", interface=str(uri), net_id=NetId(bytes(net_id[:4]) + b"\2\1"))
    router = NetId(bytes(net_id[:4]) + b"\1\1")
    return PlannedStation(
        name=names.take(plain_name(Path(file).stem, "station")),
        net_id=router,
        cycle_us=choices.cycle_us or DEFAULT_CYCLE_US,
        ports=(port,),
        variables=tuple(variables),
        remarks=("Symbols of a program: publish those that others need.",),
    )


def _interfaces(pattern: str) -> Iterator[InterfaceUri]:
    """Yield the interface of each port in turn; raise ConfigError for an invalid pattern."""
    for number in itertools.count(1):
        text = pattern.replace(NUMBER, str(number))
        try:
            uri = InterfaceUri.parse(text if "://" in text else f"udp://{text}")
            if uri.scheme == "udp" and NUMBER not in pattern:
                uri = InterfaceUri(uri.scheme, str(IPv4Address(uri.host) + (number - 1)), uri.port)
        except ValueError as exc:
            raise ConfigError(f"address {pattern!r}: {exc}") from None
        yield uri


def _add(
    target: Path,
    text: str,
    stations: Sequence[PlannedStation],
    types: Sequence[str],
    result: ImportResult,
) -> ImportResult:
    """Add the stations to the plant file *target*, or write *text* beside it."""
    replace = msgspec.structs.replace
    result = replace(result, added_to=str(target))
    before = load_plant(target)
    if before.findings:
        return replace(result, ok=False, findings=before.findings)
    lines = [line for each in stations for line in (*station_lines(each), "")][:-1]
    try:
        merged = insert_stations(_text(target), lines, types)
    except InsertionError as exc:
        why = str(exc)
    else:
        # In the folder of the plant file: paths in it start there.
        added = _checked(merged, target, result, folder=target.parent)
        if added.ok:
            return _written(target, merged, added)
        # Both are right by themselves: a station of that name, or of that NetID, is there already.
        why = "; ".join(each.message for each in added.findings[:3])
    beside = _beside(target)
    alone = _checked(text, beside, replace(result, why_beside=why), folder=target.parent)
    return _written(beside, text, alone) if alone.ok else alone


def _text(path: Path) -> str:
    # Line ends and the byte order mark stay as they are.
    return path.read_bytes().decode("utf-8")


def _checked(
    text: str, target: Path, result: ImportResult, *, folder: Path | None = None
) -> ImportResult:
    """Return *result* with the findings in *text*, which is to be the plant file *target*.

    Files that *text* names are found from *folder*.
    """
    try:
        with NamedTemporaryFile(prefix=".", suffix=".yaml", dir=folder) as trial:
            trial.write(text.encode())
            trial.flush()
            loaded = load_plant(Path(trial.name))
    except OSError as exc:
        raise EnvironmentalError(f"{target} cannot be written: {exc.strerror}") from None
    replace = msgspec.structs.replace
    if loaded.findings:
        own = tuple(replace(each, file=str(target)) for each in loaded.findings)
        return replace(result, ok=False, findings=own)
    return replace(result, plant=loaded.plant.name if loaded.plant else result.plant)


def _written(target: Path, text: str, result: ImportResult) -> ImportResult:
    with whole_file(target) as file:
        file.write(text.encode())
    return msgspec.structs.replace(result, file=str(target))


def _beside(target: Path) -> Path:
    """Return the name of a new file beside *target*."""
    names = (
        target.with_name(f"{target.stem}-import{number or ''}{target.suffix}")
        for number in itertools.count()
    )
    return next(each for each in names if not each.exists())
