"""Commands for files of other tools: ``import`` and ``export-peer``."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import Column, Renderer, TextTable, json_option, write_text
from eap.cli.params import PLANT_FILE, examples, parse_cycle
from eap.quantities import count

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.ops.imports import ImportResult
    from eap.ops.peers import PeerReport, PeerRow


@click.command(
    name="import",
    epilog=examples(
        "eapctl import Line.tsproj -o line.yaml",
        "eapctl import Line.tsproj --peer panel --address 10.0.0.{n} -o line.yaml",
        "eapctl import Line.tsproj Press.tsproj --address ethernet://eth0 -o hall.yaml",
        "eapctl import axis.tmc -o axis.yaml",
        "eapctl import cell.eni --esi esi --bus sim -o cell.yaml",
        "eapctl import esi --device EK1100 --device EL2004 -o cell.yaml",
    ),
)
@click.argument("files", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="FILE…")
@click.option(
    "-o",
    "--output-file",
    "target",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    metavar="PLANT",
    help="Plant file to write, or to add the stations to; - is stdout. Without it nothing is"
    " written.",
)
@click.option("--name", default="", metavar="NAME", help="Name of the plant [default: PLANT's]")
@click.option(
    "--address",
    default="ethernet://line{n}",
    show_default=True,
    metavar="PATTERN",
    help="Interfaces of the ports: {n} is the port's number; 10.0.0.11 is the address of the first"
    " port, the others follow; ethernet://eth0 is the interface of each on its host.",
)
@click.option(
    "--publisher",
    "identity",
    type=click.Choice(["device", "system"]),
    default="device",
    show_default=True,
    help="NetID in the frames of TwinCAT's publishers: that of the EAP device (TwinCAT 3) or of the"
    " system (TwinCAT 2).",
)
@click.option(
    "--to",
    default="",
    metavar="DESTINATION",
    help="Destination of publishers whose file has none that can be used: multicast, an address.",
)
@click.option(
    "--cycle",
    "cycle_us",
    callback=parse_cycle,
    metavar="MS",
    help="Device cycle in milliseconds [default: that of the task in the project]",
)
@click.option(
    "--peer",
    default="",
    metavar="NAME",
    help="Add a station that receives what the project sends, and sends what it expects.",
)
@click.option(
    "--bus",
    default="ethernet://bus{n}",
    show_default=True,
    metavar="PATTERN",
    help="Interfaces of bus ports: {n} is the port's number; sim simulates the slaves.",
)
@click.option(
    "--esi",
    type=click.Path(path_type=Path, exists=True),
    metavar="PATH",
    help="ESI file, or folder of ESI files, that describes the slaves of an ENI file further.",
)
@click.option(
    "--device",
    "devices",
    multiple=True,
    metavar="TYPE",
    help="Slave of a bus that is made of ESI files; repeat it for each, in their order.",
)
@json_option("Print one object: ok, file, plant, stations, bus_files, notes, findings.")
@click.pass_context
def import_files(
    ctx: click.Context,
    files: tuple[Path, ...],
    target: Path | None,
    name: str,
    address: str,
    identity: str,
    to: str,
    cycle_us: int | None,
    peer: str,
    bus: str,
    esi: Path | None,
    devices: tuple[str, ...],
    output: Renderer,
) -> None:
    """Make a plant file of the files of other tools, or add to one.

    FILE is a TwinCAT 3 project (.tsproj) or device (.xti), an Automation Interface description
    (.xml), has types and symbols (.tmc, .tpy), or describes the slaves of a bus (ENI: .eni, .xml),
    for which a bus file is written beside PLANT; ESI files give a bus of their devices. The report
    says what was taken, what was left, and why. A publisher whose settings are not known for
    certain becomes a comment: nothing is sent on a guess.

    Exits with 2 when a file cannot be read; nothing is written then.
    """
    from eap.config.imports.stations import PublisherIdentity
    from eap.ops.imports import ImportChoices, run_import

    is_stdout = str(target) == "-"
    if is_stdout and output.is_json:
        raise click.UsageError("--json describes the written file: name a file instead of -")
    choices = ImportChoices(
        plant=name,
        address=address,
        identity=PublisherIdentity(identity),
        to=to,
        cycle_us=cycle_us or 0,
        peer=peer,
        bus=bus,
        esi=esi,
        devices=devices,
    )
    result, text = run_import(files, None if is_stdout else target, choices)
    if is_stdout and result.bus_files:
        raise click.UsageError("a bus file goes beside the plant file: name a file instead of -")
    for finding in result.findings:
        output.remark(str(finding))
    if result.ok and is_stdout:
        write_text(text, end="")
    else:
        output.show(result, lambda each: _import_lines(each, target))
    if not result.ok:
        ctx.exit(ExitCode.UNUSABLE)


def _import_lines(result: ImportResult, target: Path | None) -> Iterator[RenderableType]:
    # What was taken is of no interest when nothing is written.
    notes = [each for each in result.notes if result.ok or each.outcome != "taken"]
    if notes:
        table = TextTable(
            "Outcome",
            Column("Part", wraps=True),
            Column("Reason", wraps=True),
            Column("Where", rank=1),
        )
        for note in notes:
            where = f"{Path(note.file).name}:{note.line}" if note.line else Path(note.file).name
            table.add_row(note.outcome.value, note.item, note.message, where)
        yield table
    if not result.ok:
        yield "nothing was written: correct the files or the options, or leave files out"
        return
    stations = f"{count(len(result.stations), 'station')} ({', '.join(result.stations)})"
    if target is None:
        yield f"{stations}; nothing was written: name a plant file with -o"
    elif result.why_beside:
        yield f"{result.added_to} is as it was: {result.why_beside}"
        yield f"{result.file}: {stations} in a plant file of their own: take from it what you need"
    elif result.added_to:
        yield f"{result.file}: {stations} added"
    else:
        yield f"{result.file}: plant {result.plant}, {stations}"
    if result.bus_files and target is not None:
        names = ", ".join(result.bus_files)
        yield f"{count(len(result.bus_files), 'file')} for buses: {names}"


@click.command(
    name="export-peer",
    epilog=examples(
        "eapctl export-peer line.yaml panel",
        "eapctl export-peer line.yaml panel -o panel.xml",
        "eapctl export-peer line.yaml panel -o items/",
    ),
)
@click.argument("plant", type=PLANT_FILE)
@click.argument("station")
@click.option(
    "-o",
    "--output-file",
    "target",
    metavar="FILE",
    help="Automation Interface XML to write; FOLDER/ gets one file for each tree item, - is"
    " stdout.",
)
@click.option("--force", is_flag=True, help="Overwrite existing files.")
@json_option("Print one object: station, files, and rows of the table.")
def export_peer(
    plant: Path, station: str, target: str | None, force: bool, output: Renderer
) -> None:
    """Show or write the TwinCAT configuration of the other side of STATION.

    The table is for typing: publishers and subscribers that match STATION, with their IDs, types
    and addresses. The XML descriptions are for the Automation Interface, or for 'Import XML
    Description' at each item.
    """
    from eap.config.imports.treeitems import tree_items_text
    from eap.ops.peers import peer_report, write_peer

    if target == "-" and output.is_json:
        raise click.UsageError("--json has no room for XML: name a file instead of -")
    devices, report = peer_report(plant, station)
    if target == "-":
        write_text(tree_items_text(devices), end="")
        for remark in report.remarks:
            output.remark(remark)
        return
    if target is not None:
        is_folder = target.endswith("/")
        report = write_peer(devices, report, Path(target), force=force, is_folder=is_folder)
    output.show(report, _peer_lines)


def _peer_lines(report: PeerReport) -> Iterator[RenderableType]:
    """Yield a table for each publisher and subscriber, as it is typed in TwinCAT."""
    if not report.rows:
        yield f"{report.station} exchanges no process data"
    for box, rows in _by_box(report):
        first = rows[0]
        target = "to" if first.kind == "publisher" else "from"
        address = first.address or "any"
        yield f"{first.device}: {first.kind} '{box}' {target} {address}"
        table = TextTable(
            "Variable",
            Column("ID", is_number=True),
            Column("Version", is_number=True),
            Column("Type", wraps=True),
            Column("Bytes", is_number=True),
            Column("Every"),
        )
        for row in rows:
            numbers = str(row.id), str(row.version)
            table.add_row(row.variable, *numbers, row.type, str(row.bytes), row.period)
        yield table
    yield from report.remarks
    if report.files:
        more = " …" if len(report.files) > 3 else ""
        names = ", ".join(report.files[:3])
        yield f"{count(len(report.files), 'file')} written: {names}{more}"


def _by_box(report: PeerReport) -> Iterator[tuple[str, list[PeerRow]]]:
    for (_, box), rows in groupby(report.rows, key=lambda row: (row.device, row.box)):
        yield box, list(rows)
