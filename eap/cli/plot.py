"""``eapctl plot``: charts in files and in the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.completion import complete_station, complete_variables
from eap.cli.output import repaint, write_view
from eap.cli.params import PLANT_FILE, examples

if TYPE_CHECKING:
    from rich.text import Text

    from eap.recording.chart import ChartPanel, TimeAxis
    from eap.recording.series import Series

_TERMINAL_COLORS = ("cyan", "red", "green", "magenta", "yellow", "blue", "white", "bright_black")
_LABEL = 10
"""Columns left of a chart."""
_LEAST_ROWS = 4


@click.command(
    epilog=examples(
        "eapctl plot line.mcap island-01/temp island-02/temp",
        "eapctl plot line.mcap temp --from +10s --until +5s --out temp.html",
        "eapctl plot today.mcap temp --with yesterday.mcap --out both.svg",
        "eapctl plot island-01 temp",
    )
)
@click.argument("source", metavar="FILE|STATION", shell_complete=complete_station)
@click.argument("variables", nargs=-1, metavar="[VAR]...", shell_complete=complete_variables)
@click.option(
    "--with",
    "others",
    multiple=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OTHER",
    help="Another recording over it, both from their begin on; repeatable.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="PICTURE",
    help="Write .svg, .png or .html instead of drawing in the terminal.",
)
@click.option("--from", "begin", metavar="T", help="Begin: 12:00, +30s, -10s or ISO 8601.")
@click.option("--until", "end", metavar="T", help="End; +30s counts from the begin.")
@click.option(
    "--for",
    "seconds",
    type=click.FloatRange(min=0.1),
    metavar="S",
    help="Of a station: end after S seconds [default: on Ctrl-C; with --out 10].",
)
@click.option(
    "--plant",
    type=PLANT_FILE,
    metavar="PLANT",
    help="Plant file whose PDs are in FILE, for captures of other programs.",
)
def plot(
    source: str,
    variables: tuple[str, ...],
    others: tuple[Path, ...],
    out: Path | None,
    begin: str | None,
    end: str | None,
    seconds: float | None,
    plant: Path | None,
) -> None:
    """Draw values of the recording FILE, or of a running STATION, over time.

    Values of one unit share a chart.  VAR is a variable, a part of one, or a pattern with * and ?.
    """
    if Path(source).exists() or others or _is_path(source):
        from eap.ops.plots import series_of_files

        files = [Path(source), *others]
        series, axis = series_of_files(files, variables, begin=begin, end=end, plant=plant)
        title = ", ".join(each.name for each in files)
        if out is None:
            write_view(chart_view(series, axis, *_screen()))
    else:
        series, axis = _watch(source, variables, seconds, out)
        title = source
    if out is not None:
        from eap.ops.plots import write_chart

        write_chart(out, title, series, axis)
        click.echo(f"{out}: {len(series)} lines", err=True)


def _is_path(source: str) -> bool:
    """Return whether *source* is the path of a file: no station has such a name."""
    return "/" in source or Path(source).suffix in {".mcap", ".pcapng", ".pcap"}


def _watch(
    station: str, variables: Sequence[str], seconds: float | None, out: Path | None
) -> tuple[list[Series], TimeAxis]:
    from eap.ops.client import connect_station
    from eap.ops.plots import watch_series
    from eap.recording.chart import TimeAxis, time_axis

    def show(series: list[Series], axis: TimeAxis) -> None:
        if out is None:
            repaint(chart_view(series, axis, *_screen()))

    if out is not None and seconds is None:
        seconds = 10.0
    series: list[Series] = []
    with connect_station(station, None) as client:
        try:
            series = watch_series(client, station, variables, seconds, show)
        except KeyboardInterrupt:
            if out is None:
                raise SystemExit(0) from None
            raise
    return series, time_axis(series, is_relative=False) or TimeAxis(0, 1, is_relative=False)


def _screen() -> tuple[int, int]:
    import shutil

    width, height = shutil.get_terminal_size((80, 24))
    return width, height


def chart_view(series: Sequence[Series], axis: TimeAxis, width: int, height: int) -> Iterator[Text]:
    """Yield a chart of braille for each unit, and the times below."""
    from eap.recording.chart import panels_of

    panels = panels_of(series)
    # A line of names for each panel, the times, and one line for the prompt of the shell.
    rows = max(_LEAST_ROWS, (height - 2 - len(panels)) // len(panels))
    for panel in panels:
        yield from _panel(series, panel, axis, width, rows)
    yield _times(axis, width)


def _panel(
    series: Sequence[Series], panel: ChartPanel, axis: TimeAxis, width: int, rows: int
) -> Iterator[Text]:
    from rich.text import Text

    from eap.recording.chart import braille, value_ticks

    numbers = {id(each): number for number, each in enumerate(series)}
    heading = Text(f"{panel.unit:>{_LABEL - 1}} ", no_wrap=True, overflow="ellipsis")
    for each in panel.series:
        last = next((f"{value:.6g}" for value in reversed(each.values) if not isnan(value)), "-")
        heading.append(f"{each.name} {last}  ", _color(numbers[id(each)]))
    yield heading
    labels = {}
    for tick in value_ticks(panel.low, panel.high, rows // 3):
        share = (tick.at - panel.low) / (panel.high - panel.low)
        labels[rows - 1 - min(int(share * rows), rows - 1)] = tick.text
    for number, row in enumerate(braille(series, panel, axis, width - _LABEL - 1, rows)):
        line = Text(f"{labels.get(number, ''):>{_LABEL - 1}} ", no_wrap=True)
        line.append("┤" if number in labels else "│", "dim")
        for character, owner in row:
            line.append(character, "" if owner is None else _color(owner))
        yield line


def _times(axis: TimeAxis, width: int) -> Text:
    from rich.text import Text

    from eap.recording.chart import time_ticks

    inner = width - _LABEL - 1
    line = [" "] * width
    end = 0
    for tick in time_ticks(axis, max(inner // 16, 1)):
        share = (tick.at - axis.from_ns) / (axis.until_ns - axis.from_ns)
        at = _LABEL + 1 + round(share * (inner - 1)) - len(tick.text) // 2
        at = min(max(at, end), width - len(tick.text))
        if at >= end:
            line[at : at + len(tick.text)] = tick.text
            end = at + len(tick.text) + 1
    return Text("".join(line).rstrip(), "dim", no_wrap=True)


def _color(number: int) -> str:
    return _TERMINAL_COLORS[number % len(_TERMINAL_COLORS)]
