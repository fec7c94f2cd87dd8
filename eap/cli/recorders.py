"""Commands for recorders: ``record start``, ``list``, ``stop``, ``mark`` and ``snapshot``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eap.cli.completion import complete_variables
from eap.cli.output import Column, Renderer, TextTable, json_option
from eap.cli.params import examples, plant_option
from eap.quantities import age, count, size

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.config.record_texts import Distance, FileSplit
    from eap.runtime.recordings import RecordingState


class Seconds(click.ParamType[int]):
    """A time such as ``20s``, ``500ms``, ``1h`` or ``10``, which is in seconds; in nanoseconds.

    Args:
        is_of_ring: Whether it is a time in memory, which is bounded.
    """

    name = "time"

    def __init__(self, *, is_of_ring: bool = False) -> None:
        self._is_of_ring = is_of_ring

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return nanoseconds."""
        from eap.config.record_texts import parse_ring, parse_time

        if isinstance(value, int):
            return value
        try:
            return parse_ring(value) if self._is_of_ring else parse_time(value)
        except ValueError as exc:
            self.fail(str(exc), param, ctx)


def _parse_every(ctx: click.Context, param: click.Parameter, text: str) -> Distance:
    from eap.config.record_texts import parse_every

    del ctx, param
    try:
        return parse_every(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def _parse_split(ctx: click.Context, param: click.Parameter, text: str | None) -> FileSplit:
    from eap.config.record_texts import FileSplit, parse_split

    del ctx, param
    try:
        return FileSplit() if text is None else parse_split(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


@click.command(
    epilog=examples(
        "eapctl record start -o line",
        "eapctl record start 'island-*/temp' -o t --every 100ms --split 1h --keep 24",
        "eapctl record start island-03 --frames -o island --for 60s",
        "eapctl record start -o fault --ring 60s --when 'island-03/temp>80 or lost'",
        "eapctl record start --to postgresql://logger@db.example/plant",
    ),
)
@click.argument("patterns", nargs=-1, metavar="[PATTERN]...", shell_complete=complete_variables)
@click.option(
    "-o",
    "--out",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="NAME",
    help="Path of the files, without number and ending; its last part names the recording."
    " Default: the plant's name.",
)
@click.option("--values", "kind", flag_value="values", help="Record variables (default).")
@click.option("--frames", "kind", flag_value="frames", help="Record frames of EAP and bus ports.")
@click.option(
    "--every",
    default="1",
    metavar="N|MSms",
    callback=_parse_every,
    help="Record each N-th cycle, or every MS milliseconds.",
)
@click.option("--for", "for_ns", type=Seconds(), metavar="TIME", help="End after TIME.")
@click.option(
    "--ring",
    "ring_ns",
    type=Seconds(is_of_ring=True),
    metavar="TIME",
    help="Keep the last TIME in memory, and write it on --when or 'record snapshot'.",
)
@click.option("--when", metavar="CONDITION", help="Write a file when CONDITION becomes true.")
@click.option(
    "--before",
    "before_ns",
    type=Seconds(is_of_ring=True),
    metavar="TIME",
    help="With --when: time before that.  Default: that of --ring, else 20s.",
)
@click.option(
    "--after",
    "after_ns",
    type=Seconds(),
    metavar="TIME",
    help="With --when: time behind that.  Default: 10s.",
)
@click.option(
    "--split",
    metavar="TIME|SIZE",
    callback=_parse_split,
    help="Begin another file after TIME (1h) or SIZE (1GB).",
)
@click.option(
    "--keep",
    type=click.IntRange(1),
    metavar="N",
    help="Keep the last N files of this recording, and remove older ones.",
)
@click.option(
    "--to",
    metavar="URL",
    help="Send values to a store instead: postgresql://host/database, influx+http://host/path,"
    " influx+udp://host.",
)
@plant_option
@json_option("Print one object: the state of the recording.")
def start(
    patterns: tuple[str, ...],
    target: Path | None,
    kind: str | None,
    every: Distance,
    for_ns: int | None,
    ring_ns: int | None,
    when: str | None,
    before_ns: int | None,
    after_ns: int | None,
    split: FileSplit,
    keep: int | None,
    to: str | None,
    plant: str | None,
    output: Renderer,
) -> None:
    """Record values or frames of the running plant, in a process of its own.

    PATTERN is STATION, STATION/VARIABLE or STATION/PD, with --frames STATION or STATION/PORT; *
    stands for any text.  Without one all are recorded.  CONDITION compares variables
    (STATION/VARIABLE) and counters (lost, late, dropped, skipped, overruns, also as
    STATION/lost), which count from one look to the next, 50 ms: 'island-03/temp>80 or lost'.

    The recorder goes on when the terminal is closed, and over restarts of the plant.
    """
    from eap.config.record_texts import RecordTimes, completed, find_contradiction
    from eap.expressions import Condition
    from eap.ops.recorders import start_recording
    from eap.recording.recorder import RecorderOptions

    if target is not None and not target.name:
        raise click.UsageError("-o: a name is missing")
    times = RecordTimes(ring_ns or 0, before_ns or 0, after_ns or 0)
    has_files = any(split) or bool(keep)
    kind = kind or "values"
    found = find_contradiction(kind, every, times, when or "", to or "", has_files=has_files)
    if found:
        raise click.UsageError(f"--{found[0]}: {found[1]}")
    if when is not None:
        try:
            Condition(when)
        except ValueError as exc:
            raise click.UsageError(str(exc)) from None
    times = completed(times, when or "")
    options = RecorderOptions(
        name="",
        kind=kind,
        base="",
        plant="",
        folder="",
        patterns=patterns,
        **every._asdict(),
        **times._asdict(),
        **split._asdict(),
        for_ns=for_ns or 0,
        when=when or "",
        keep=keep or 0,
        to=to or "",
    )
    output.show(start_recording(options, plant, target), _started)


def _started(state: RecordingState) -> str:
    things = "variable" if state.kind == "values" else "port"
    begin = f"recording {state.name!r}: {count(state.selected, things)} of {state.plant}"
    end = f"end it with: eapctl record stop {state.name}"
    if state.state == "waiting":
        return f"recording {state.name!r} waits: {state.reason}; {end}"
    if state.state == "armed":
        when = state.options.get("when")
        until = f"until {when}" if when else "for 'eapctl record snapshot'"
        return f"{begin} in memory, {until}; {end}"
    target = state.files[-1] if state.files else state.options.get("to", "")
    return f"{begin} to {target}; {end}"


@click.command("list", epilog=examples("eapctl record list", "eapctl record list --json"))
@plant_option
@json_option("Print one object a recording.")
def list_recordings(plant: str | None, output: Renderer) -> None:
    """List the recordings that run, and those that ended lately."""
    from eap.ops.recorders import list_recordings as found

    output.show_rows(found(plant), _table)


_NAME = click.argument("name", required=False)


@click.command(epilog=examples("eapctl record stop line", "eapctl record stop --all"))
@_NAME
@click.option("--all", "stops_all", is_flag=True, help="End all recordings that run.")
@json_option("Print one object a recording.")
def stop(name: str | None, stops_all: bool, output: Renderer) -> None:
    """End the recording NAME; without a name the only one that runs."""
    from eap.ops.recorders import only_recording, running_names, stop_recording

    if name and stops_all:
        raise click.UsageError("NAME and --all contradict each other")
    running = running_names(stoppable=True)
    names = running if stops_all else [name or only_recording(running)]
    output.show_rows((stop_recording(each) for each in names), _ended)


@click.command(epilog=examples('eapctl record mark "door open"'))
@click.argument("text")
@click.option("--recording", metavar="NAME", help="Only this one.  Default: all that run.")
@json_option("Print one object a recording.")
def mark(text: str, recording: str | None, output: Renderer) -> None:
    """Write TEXT with the present time into the recordings that run."""
    from eap.ops.recorders import mark_recording, only_recording, running_names

    names = [recording] if recording else running_names()
    if not names:
        only_recording(names)  # which says that none runs
    output.show_rows(
        (mark_recording(each, text) for each in names),
        lambda states: (f"recording {state.name!r}: marked {text!r}" for state in states),
    )


@click.command(epilog=examples("eapctl record snapshot", "eapctl record snapshot fault"))
@_NAME
@json_option("Print one object: the state of the recording.")
def snapshot(name: str | None, output: Renderer) -> None:
    """Write the ring of the recording NAME to a file, and go on."""
    from eap.ops.recorders import list_recordings as found
    from eap.ops.recorders import only_recording, snapshot_recording

    rings = [each.name for each in found() if not each.is_over and each.ring_s is not None]
    state = snapshot_recording(name or only_recording(rings))
    output.show(state, lambda each: f"recording {each.name!r}: {each.files[-1]}")


def _ended(states: Iterable[RecordingState]) -> Iterator[str]:
    for state in states:
        things = "message" if state.kind == "values" else "frame"
        missing = state.lost + state.not_stored
        lost = f"{missing} lost" if missing else "none lost"
        files = ", ".join(state.files) or state.options.get("to", "no file")
        yield f"recording {state.name!r}: {count(state.messages, things)}, {lost}; {files}"


def _table(states: Iterable[RecordingState]) -> Iterator[RenderableType]:
    rows = list(states)
    if not rows:
        yield "no recordings"
        return
    table = TextTable(
        Column("NAME"),
        Column("STATE"),
        Column("PLANT", rank=2),
        Column("KIND", rank=1),
        Column("FOR", is_number=True),
        Column("MESSAGES", is_number=True),
        Column("SIZE", is_number=True),
        Column("LOST", is_number=True),
        Column("FILE", rank=3),
    )
    for state in rows:
        until = state.ended_at or datetime.now().astimezone().timestamp()
        table.add_row(
            state.name,
            state.state,
            state.plant,
            state.kind,
            age(state.started_at, until),
            str(state.messages),
            size(state.octets),
            str(state.lost + state.not_stored),
            state.files[-1] if state.files else state.options.get("to", ""),
        )
    yield table
    for state in rows:
        if state.reason and state.reason != "stopped":
            yield f"{state.name}: {state.reason}"
        if state.ring_s is not None and not state.is_over:
            cut = ", all that fits into its memory" if state.ring_is_cut else ""
            yield f"{state.name}: {state.ring_s:g} s in memory{cut}; triggered {state.triggers}"
