"""Commands for recorders: ``record start``, ``list``, ``stop``, ``mark`` and ``snapshot``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eap.cli.output import Column, Renderer, TextTable
from eap.cli.params import examples, json_option, plant_option
from eap.quantities import count, duration

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.runtime.recordings import RecordingState

_SECONDS = {"ms": 0.001, "s": 1, "m": 60, "min": 60, "h": 3600, "d": 86400}
_BYTES = {"KB": 1000, "MB": 1000**2, "GB": 1000**3}
_AMOUNT = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]*)")
_DAY_NS = 86_400 * 10**9
_LONGEST_NS = 3650 * _DAY_NS
_LONGEST_RING_NS = _DAY_NS
_MOST_CYCLES = 10**9
_BEFORE_NS, _AFTER_NS = 20 * 10**9, 10 * 10**9


class Seconds(click.ParamType[int]):
    """A time such as ``20s``, ``500ms``, ``1h`` or ``10``, which is in seconds; in nanoseconds."""

    name = "time"

    def __init__(self, longest_ns: int = _LONGEST_NS) -> None:
        self._longest_ns = longest_ns

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return nanoseconds."""
        if isinstance(value, int):
            return value
        match = _AMOUNT.fullmatch(value.strip())
        unit = _SECONDS.get(match[2].lower() or "s") if match else None
        ns = int(float(match[1]) * unit * 1e9) if match and unit else 0
        if not 0 < ns <= self._longest_ns:
            longest = duration(self._longest_ns // 1000)
            self.fail(
                f"{value!r} is not a time: expected for example 20s, 500ms, 10min or 1h, {longest}"
                " at most",
                param,
                ctx,
            )
        return ns


def _parse_every(ctx: click.Context, param: click.Parameter, text: str) -> tuple[int, int]:
    """Return cycles and milliseconds, one of them 0."""
    del ctx, param
    match = re.fullmatch(r"(\d+)(ms)?", text.strip(), re.IGNORECASE)
    number = int(match[1]) if match else 0
    if match is None or not 0 < number <= _MOST_CYCLES:
        raise click.BadParameter(f"{text!r}: expected cycles, such as 10, or a time such as 100ms")
    return (1, number) if match[2] else (number, 0)


def _parse_split(ctx: click.Context, param: click.Parameter, text: str | None) -> tuple[int, int]:
    """Return nanoseconds and bytes, one of them 0."""
    del ctx, param
    if text is None:
        return 0, 0
    match = _AMOUNT.fullmatch(text.strip())
    if match and (unit := _BYTES.get(match[2].upper())):
        size = int(float(match[1]) * unit)
        if size >= 1:
            return 0, size
    elif match and (seconds := _SECONDS.get(match[2].lower())):
        ns = int(float(match[1]) * seconds * 1e9)
        if 0 < ns <= _LONGEST_NS:
            return ns, 0
    raise click.BadParameter(f"{text!r}: expected a time such as 1h, or a size such as 1GB")


@click.command(
    epilog=examples(
        "eapctl record start -o line",
        "eapctl record start 'island-*/temp' -o temp --every 100ms --split 1h --keep 24",
        "eapctl record start island-03 --frames -o island --for 60s",
        "eapctl record start -o fault --ring 60s --when 'island-03/temp>80 or lost'",
        "eapctl record start --to postgresql://logger@db.example/plant",
    ),
)
@click.argument("patterns", nargs=-1, metavar="[PATTERN]...")
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
    type=Seconds(_LONGEST_RING_NS),
    metavar="TIME",
    help="Keep the last TIME in memory, and write it on --when or 'record snapshot'.",
)
@click.option("--when", metavar="CONDITION", help="Write a file when CONDITION becomes true.")
@click.option(
    "--before",
    "before_ns",
    type=Seconds(_LONGEST_RING_NS),
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
    every: tuple[int, int],
    for_ns: int | None,
    ring_ns: int | None,
    when: str | None,
    before_ns: int | None,
    after_ns: int | None,
    split: tuple[int, int],
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
    from eap.expressions import Condition
    from eap.ops.recorders import start_recording
    from eap.recording.recorder import RecorderOptions

    _check_options(kind, every, ring_ns, when, before_ns, after_ns)
    if to and (kind == "frames" or ring_ns or when or split != (0, 0) or keep):
        raise click.UsageError("--to takes values as they come: without --frames, a ring, or files")
    if when is not None:
        try:
            Condition(when)
        except ValueError as exc:
            raise click.UsageError(str(exc)) from None
        before_ns = before_ns or ring_ns or _BEFORE_NS
        after_ns = after_ns or _AFTER_NS
        ring_ns = max(ring_ns or 0, before_ns)
    options = RecorderOptions(
        name="",
        kind=kind or "values",
        base="",
        plant="",
        folder="",
        patterns=patterns,
        every_cycles=every[0],
        every_ms=every[1],
        for_ns=for_ns or 0,
        ring_ns=ring_ns or 0,
        when=when or "",
        before_ns=before_ns or 0,
        after_ns=after_ns or 0,
        split_ns=split[0],
        split_bytes=split[1],
        keep=keep or 0,
        to=to or "",
    )
    output.show(start_recording(options, plant, target), _started)


def _check_options(
    kind: str | None,
    every: tuple[int, int],
    ring_ns: int | None,
    when: str | None,
    before_ns: int | None,
    after_ns: int | None,
) -> None:
    if kind == "frames" and every != (1, 0):
        raise click.UsageError("--every is for values: frames are recorded as they come")
    if when is None and (before_ns or after_ns):
        raise click.UsageError("--before and --after need --when CONDITION")
    if ring_ns and before_ns and before_ns > ring_ns:
        raise click.UsageError("--before is longer than --ring")


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
    names = running_names() if stops_all else [name or only_recording(running_names())]
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
            duration(int(max(0.0, until - state.started_at) * 1e6)),
            str(state.messages),
            _size(state.octets),
            str(state.lost),
            state.files[-1] if state.files else "",
        )
    yield table
    for state in rows:
        if state.reason and state.reason != "stopped":
            yield f"{state.name}: {state.reason}"
        if state.ring_s is not None and not state.is_over:
            cut = ", all that fits into its memory" if state.ring_is_cut else ""
            yield f"{state.name}: {state.ring_s:g} s in memory{cut}; triggered {state.triggers}"


def _size(octets: int) -> str:
    if octets < 1000:
        return f"{octets} B"
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if octets >= size:
            return f"{octets / size:.1f} {unit}"
    return ""
