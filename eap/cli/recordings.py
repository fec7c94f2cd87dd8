"""Commands for recordings that are there: ``record info``, ``record repair`` and ``export``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import Column, Renderer, TextTable, json_option, write_text
from eap.cli.params import PLANT_FILE, examples
from eap.quantities import count, size

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.ops.recordings import ExportResult
    from eap.recording.recording_file import RecordingInfo

RECORDING = click.Path(path_type=Path, dir_okay=False)
"""Path of a recording; the reader reports why it cannot be read."""
_SHOWN_EVENTS = 20


@click.command(
    epilog=examples("eapctl record info line.mcap", "eapctl record info a.pcapng --json")
)
@click.argument("file", type=RECORDING)
@json_option("Print one object.")
def info(file: Path, output: Renderer) -> None:
    """Describe the recording FILE: times, variables or ports, losses, marks.

    A recording that runs, or whose recorder was killed, is described as far as it was written.
    """
    from eap.recording.recording_file import describe

    output.show(describe(file), info_view)


@click.command(epilog=examples("eapctl record repair line.mcap"))
@click.argument("file", type=RECORDING)
def repair(file: Path) -> None:
    """Give FILE the end that a killed recorder did not write.

    Programs such as Foxglove and PlotJuggler need it; eapctl reads the file without.  What is whole
    stays; a part of the last second is cut off.
    """
    from eap.recording.repair import finish_recording

    cut = finish_recording(file)
    click.echo(f"{file}: finished, {count(cut, 'byte')} cut off", err=True)


@click.command(
    epilog=examples(
        "eapctl export line.mcap --csv island-01/temp island-02",
        "eapctl export line.mcap --parquet --from 12:00 --until +30s",
        "eapctl export line.pcapng --mcap -o line.mcap",
        "eapctl export tcpdump.pcap --plant line.yaml --csv -o -",
    )
)
@click.argument("file", type=RECORDING)
@click.argument("variables", nargs=-1, metavar="[VAR]...")
@click.option("--csv", "form", flag_value="csv", help="Text: time_ns, then a column a variable.")
@click.option("--parquet", "form", flag_value="parquet", help="Parquet, for pandas and others.")
@click.option("--mcap", "form", flag_value="mcap", help="Values as recorded; of frames too.")
@click.option("--pcapng", "form", flag_value="pcapng", help="Frames as recorded.")
@click.option(
    "-o",
    "--output-file",
    "target",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    metavar="OUT",
    help="File to write [default: FILE with another suffix]; - is stdout, for CSV.",
)
@click.option("--from", "begin", metavar="T", help="Begin: 12:00, +30s, -10s or ISO 8601.")
@click.option("--until", "end", metavar="T", help="End; +30s counts from the begin.")
@click.option(
    "--plant",
    "plant",
    type=PLANT_FILE,
    metavar="PLANT",
    help="Plant file whose PDs are in FILE, for captures of other programs.",
)
@click.option("--force", is_flag=True, help="Overwrite OUT.")
@json_option("Print one object.")
def export(
    file: Path,
    variables: tuple[str, ...],
    form: str | None,
    target: Path | None,
    begin: str | None,
    end: str | None,
    plant: Path | None,
    force: bool,
    output: Renderer,
) -> None:
    """Write the recording FILE, or a part of it, in another form.

    VAR is a variable as STATION/NAME, a part of one, a station, or a pattern with * and ?; none
    takes all.  Frames become values by the PDs of the plant that is in FILE.
    """
    from eap.ops.recordings import ExportRequest, export_recording

    if form is None:
        raise click.UsageError("expected a form: --csv, --parquet, --mcap or --pcapng")
    request = ExportRequest(
        file=file,
        form=form,
        target=target,
        variables=variables,
        begin=begin,
        end=end,
        plant=plant,
        is_forced=force,
    )
    result = export_recording(request, lambda text: write_text(text, end=""))
    if result.file != "-":
        output.show(result, _export_text)


def _export_text(result: ExportResult) -> str:
    if result.columns:
        rows = f"{result.file}: {count(result.rows, 'row')} of {count(result.columns, 'column')}"
        missing = result.damaged_chunks
        return (
            f"{rows}; {count(missing, 'chunk')} damaged: their values are missing"
            if missing
            else rows
        )
    return f"{result.file}: {count(result.rows, 'frame')}"


def info_view(found: RecordingInfo) -> Iterator[RenderableType]:
    """Yield the facts, then variables and events."""
    yield f"{found.file}: {found.kind} of {found.plant or 'an unknown plant'}, {size(found.bytes)}"
    if found.from_ is not None:
        yield f"{found.from_} to {found.until}, {found.seconds:.3f} s"
    things = "frame" if found.kind == "frames" else "message"
    yield count(found.messages, things) + (f", {found.lost} lost" if found.lost else ", none lost")
    yield from _condition(found)
    options = {key: text for key, text in found.facts.items() if key not in _INTERNAL}
    listed = {
        "": "  ".join(f"{key} {text}" for key, text in options.items()),
        "ports: ": ", ".join(found.interfaces),
        "inside: ": ", ".join(found.files),
    }
    yield from (heading + text for heading, text in listed.items() if text)
    if found.types:
        table = TextTable("Variable", Column("Type", wraps=True), "Unit")
        for name, variable in found.types.items():
            table.add_row(name, variable.type, variable.unit)
        yield table
    for event in found.events[:_SHOWN_EVENTS]:
        lost = f"{event.count} lost" if event.count else ""
        yield "  ".join(filter(None, (event.time, event.kind, event.station, lost, event.text)))
    if (more := len(found.events) - _SHOWN_EVENTS) > 0:
        yield f"… {count(more, 'more event')}"


def _condition(found: RecordingInfo) -> Iterator[str]:
    if found.recording:
        yield "being recorded"
    elif not found.finished:
        yield f"unfinished: its recorder was killed; eapctl record repair {found.file} finishes it"
    if found.damaged_chunks:
        yield f"{count(found.damaged_chunks, 'chunk')} damaged: their values are missing"


_INTERNAL = {"format", "started_ns"}
