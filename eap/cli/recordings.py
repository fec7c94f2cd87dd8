"""Commands for recordings that are there: ``record info`` and ``record repair``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import Column, Renderer, TextTable
from eap.cli.params import examples, json_option
from eap.quantities import count

if TYPE_CHECKING:
    from rich.console import RenderableType

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


def info_view(found: RecordingInfo) -> Iterator[RenderableType]:
    """Yield the facts, then variables and events."""
    yield f"{found.file}: {found.kind} of {found.plant or 'an unknown plant'}, {_size(found.bytes)}"
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


def _size(octets: int) -> str:
    for unit in ("bytes", "kB", "MB"):
        if octets < 1000 or unit == "MB":
            break
        octets //= 1000
    return f"{octets} {unit}"
