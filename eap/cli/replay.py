"""``eapctl replay``: sends recorded frames or values again."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import Column, Renderer, TextTable, json_option
from eap.cli.params import PLANT_FILE, examples
from eap.quantities import count, duration

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.ops.replay import Replay, ReplayRequest, ReplayResult
    from eap.recording.replay import ReplayFrame


_LARGE_BYTES = 100_000_000


@click.command(
    epilog=examples(
        "eapctl replay line.pcapng --dry-run",
        "eapctl replay line.pcapng --rate 2 --loop --only 'island-01/*'",
        "eapctl replay line.mcap --only island-01 --as island-02",
    )
)
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--rate",
    type=click.FloatRange(0.001, 1000),
    default=1.0,
    show_default=True,
    metavar="X",
    help="So many times as fast as recorded.",
)
@click.option("--loop", is_flag=True, help="Begin again at the end, until Ctrl-C.")
@click.option(
    "--only",
    default="",
    metavar="PATTERN",
    help="Only a STATION, STATION/PORT, STATION/PD or publisher; * and ? are allowed.",
)
@click.option(
    "--as",
    "as_station",
    default="",
    metavar="STATION",
    help="Send as another station of the plant.",
)
@click.option("--step", is_flag=True, help="Send a frame for each Enter.")
@click.option("--dry-run", is_flag=True, help="Show what would be sent, and send nothing.")
@click.option("--force", is_flag=True, help="Send even if the publisher is alive.")
@click.option(
    "--plant",
    type=PLANT_FILE,
    metavar="PLANT",
    help="Plant file of a capture of another program.",
)
@json_option("Print one object.")
def replay(
    file: Path,
    rate: float,
    loop: bool,
    only: str,
    as_station: str,
    step: bool,
    dry_run: bool,
    force: bool,
    plant: Path | None,
    output: Renderer,
) -> None:
    """Send the process data of the recording FILE again, as its publishers sent it.

    Frames are sent as they were recorded; values as the frames of the plant that carry them.  A
    publisher that is alive is refused.  eapctl status shows the stations as replayed.
    """
    from eap.ops.replay import Replay, ReplayRequest

    request = ReplayRequest(
        file=file,
        rate=rate,
        is_loop=loop,
        only=only,
        as_station=as_station,
        is_forced=force,
        plant=plant,
    )
    if (size := _size_of(file)) >= _LARGE_BYTES:
        click.echo(f"{file}: reading {size // 1_000_000} MB, which takes a while", err=True)
    running = Replay(request)
    if not dry_run:
        _run(running, request, is_stepped=step)
    output.show(running.result(), planned_view if dry_run else sent_view)


def _run(running: Replay, request: ReplayRequest, *, is_stepped: bool) -> None:
    """Send all frames, until the end or a signal."""

    def end(*_: object) -> None:
        running.stopped.set()
        if is_stepped:
            raise KeyboardInterrupt  # without it Python goes on to wait for the line

    def report() -> None:
        click.echo(_begin_text(running.result(), request), err=True)

    ends = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(each, end) for each in ends]
    try:
        with suppress(KeyboardInterrupt):
            running.run(_wait_step if is_stepped else None, notify_begin=report)
    finally:
        for each, handler in zip(ends, before, strict=True):
            signal.signal(each, handler)


def _size_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:  # reported by the reader
        return 0


def _begin_text(result: ReplayResult, request: ReplayRequest) -> str:
    publishers = {row.publisher for row in result.frames}
    again = " again and again" if request.is_loop else ""
    return (
        f"{result.file}: sending {result.seconds / request.rate:.1f} s of"
        f" {count(len(publishers), 'publisher')}{again}; Ctrl-C ends it"
    )


def _wait_step(frame: ReplayFrame) -> bool:
    sender = frame.sender
    names = ", ".join(frame.names) or f"{len(frame.data)} bytes"
    click.echo(
        f"{sender.station}/{sender.port} → {frame.destination}: {names} ", nl=False, err=True
    )
    return bool(sys.stdin.readline())


def planned_view(result: ReplayResult) -> Iterator[RenderableType]:
    """Yield the frames that a replay sends."""
    table = TextTable(
        "Publisher",
        Column("NetID", rank=3),
        Column("Interface", rank=2),
        "To",
        Column("PDs", wraps=True),
        Column("Frames", is_number=True),
        Column("/s", rank=1, is_number=True),
    )
    for row in result.frames:
        table.add_row(
            f"{row.station}/{row.port}",
            row.publisher,
            row.interface,
            row.destination,
            ", ".join(row.pds),
            str(row.frames),
            "" if row.per_s is None else f"{row.per_s:g}",
        )
    yield table
    yield f"{result.seconds:.3f} s of {result.plant or 'an unknown plant'}"
    yield from _left_out(result)


def sent_view(result: ReplayResult) -> Iterator[RenderableType]:
    """Yield what was sent."""
    yield f"{count(result.sent, 'frame')} sent, at most {duration(result.late_us)} late"
    for reason, number in result.failed.items():
        yield f"{count(number, 'frame')} not sent: {reason}"
    yield from _left_out(result)


def _left_out(result: ReplayResult) -> Iterator[str]:
    for name, why in result.left_out.items():
        yield f"left out: {name}: {why}"
