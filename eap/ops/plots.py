"""Series for charts: of recordings, and of a running station."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from eap.codec.datatypes import variable_of
from eap.control.protocol import VARIABLES
from eap.errors import ConfigError
from eap.ops.recordings import published_in
from eap.recording.chart import Drawing, TimeAxis, draw, panels_of, time_axis
from eap.recording.recording_file import open_recording
from eap.recording.rows import select
from eap.recording.series import Series, read_series
from eap.recording.window import parse_window

if TYPE_CHECKING:
    from eap.ops.client import ControlClient

MAX_SERIES = 64
"""More lines than that tell nothing, and their values fill the memory."""
PERIOD_MS = 50
"""Distance of the values of a running station."""


def series_of_files(
    files: Sequence[Path],
    variables: Sequence[str],
    *,
    begin: str | None,
    end: str | None,
    plant: Path | None,
) -> tuple[list[Series], TimeAxis]:
    """Return the values of *variables* in all files, and their range of times.

    Series of several files begin at 0.

    Raises:
        ConfigError: a variable or time does not fit, or there is nothing to draw.
        MalformedError: a file is no recording.
        OSError: a file cannot be read.
    """
    published = published_in(plant)
    found: list[Series] = []
    is_relative = len(files) > 1
    for file in files:
        recording = open_recording(file, published)
        window = parse_window(begin, end, recording.first_ns, recording.last_ns)
        selection = select(recording.sources, variables)
        label = f"{file.stem}: " if is_relative else ""
        series = read_series(recording, window, selection, label)
        if is_relative:
            first_ns = window.from_ns or recording.first_ns or 0
            for each in series:
                each.shift(-first_ns)
        found += series
    if len(found) > MAX_SERIES:
        raise ConfigError(f"{len(found)} lines are too many, at most {MAX_SERIES}: name variables")
    axis = time_axis(found, is_relative=is_relative)
    if axis is None:
        why = "no value in that time" if found else "no numbers: texts and bytes are not drawn"
        raise ConfigError(f"nothing to draw: {why}")
    return found, axis


def watch_series(
    client: ControlClient,
    station: str,
    variables: Sequence[str],
    seconds: float | None,
    show: Callable[[list[Series], TimeAxis], object],
) -> list[Series]:
    """Collect values of a running station for *seconds*, else until interrupted.

    *show* is called with the series a few times a second.

    Raises:
        ConfigError: there are no numbers among the variables.
        ControlError: the appliance refused or ended.
    """
    found: dict[str, Series] = {}
    shown_ns = 0
    until_ns = None if seconds is None else time.time_ns() + round(seconds * 1e9)
    units = {each.name: each.unit for each in client.call(VARIABLES, station=station)}
    for event in client.events(station=station, names=tuple(variables), period_ms=PERIOD_MS):
        now_ns = time.time_ns()
        for name, value in event.values.items():
            if isinstance(value, bool | int | float):
                series = found.get(name)
                if series is None:
                    series = Series(
                        f"{station}/{name}",
                        units.get(variable_of(name, units), ""),
                        isinstance(value, bool),
                    )
                    found[name] = series
                series.add(now_ns, float(value))
        if not found:
            raise ConfigError(
                f"{station}: no numbers among {', '.join(event.values)}; name parts of structs and"
                " arrays, such as axis.position or list[2]"
            )
        if len(found) > MAX_SERIES:
            raise ConfigError(f"{len(found)} lines are too many, at most {MAX_SERIES}")
        if now_ns - shown_ns >= 250_000_000:
            shown_ns = now_ns
            axis = time_axis(list(found.values()), is_relative=False)
            if axis is not None:
                show(list(found.values()), axis)
        if until_ns is not None and now_ns >= until_ns:
            break
    return list(found.values())


def write_chart(path: Path, title: str, series: Sequence[Series], axis: TimeAxis) -> None:
    """Write a chart as the suffix of *path* says: .svg, .png or .html.

    Raises:
        ConfigError: it is another suffix.
        EnvironmentalError: an extra is missing.
        OSError: the file cannot be written.
    """
    drawing = draw(title, series, axis, 1000, 120 + 240 * len(panels_of(series)))
    path.write_bytes(_encoded(path.suffix.lower(), drawing, series, axis))


def _encoded(suffix: str, drawing: Drawing, series: Sequence[Series], axis: TimeAxis) -> bytes:
    if suffix == ".svg":
        from eap.recording.chart_svg import to_svg

        return to_svg(drawing).encode()
    if suffix == ".html":
        from eap.recording.chart_svg import to_html

        return to_html(drawing, series, axis).encode()
    if suffix == ".png":
        from eap.recording.chart_png import to_png

        return to_png(drawing)
    raise ConfigError(f"{suffix or 'no suffix'} is no form of a chart: .svg, .png or .html")
