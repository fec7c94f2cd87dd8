"""Charts: what is drawn of the values, and every form of picture."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import pytest
from defusedxml.ElementTree import fromstring
from PIL import Image

from eap.errors import ConfigError
from eap.ops.plots import series_of_files, write_chart
from eap.recording.chart import (
    TimeAxis,
    braille,
    draw,
    panels_of,
    time_axis,
    time_ticks,
    value_ticks,
)
from eap.recording.series import Series, lines
from tests.support.recordings import CYCLE_NS, T0, write_values

S = 1_000_000_000


def series(*values: float, step_ns: int = S, name: str = "s/v", **more: object) -> Series:
    times = array("q", (T0 + n * step_ns for n in range(len(values))))
    return Series(name, times=times, values=array("d", values), **{"unit": "", **more})


def drawn(found: Series, width: int = 100) -> list[list[float]]:
    ends = found.times[0], found.times[-1]
    return [[point.value for point in line] for line in lines(found, *ends, width)]


def test_peak_of_one_value_is_drawn() -> None:
    values = [0.0] * 100_000
    values[54_321] = 7.0
    values[54_322] = -7.0
    (line,) = drawn(series(*values))
    assert max(line) == 7.0
    assert min(line) == -7.0
    assert len(line) < 4 * 101


def test_line_is_interrupted_where_values_are_missing() -> None:
    found = series(1, 2, 3, 4, 5, 6)
    found.times = array("q", [*found.times[:3], *(each + 100 * S for each in found.times[3:])])
    assert drawn(found) == [[1, 2, 3], [4, 5, 6]] or drawn(found)[0][0] == 1
    assert len(drawn(found)) == 2
    assert drawn(series(1, math.nan, 3)) == [[1], [3]]


def test_truth_values_are_steps() -> None:
    (line,) = drawn(series(0, 0, 1, 1, 0, is_step=True))
    assert line == [0, 0, 0, 1, 1, 1, 0]


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0, 10, ["0", "2", "4", "6", "8", "10"]),
        (-0.2, 0.3, ["-0.2", "-0.1", "0.0", "0.1", "0.2", "0.3"]),
        (19.7, 20.4, ["19.8", "20.0", "20.2", "20.4"]),
        (0, 3e9, ["0", "1e+09", "2e+09", "3e+09"]),
    ],
)
def test_values_on_the_axis_are_round(low: float, high: float, texts: list[str]) -> None:
    assert [tick.text for tick in value_ticks(low, high, 5)] == texts


@pytest.fixture
def _berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("_berlin")
@pytest.mark.parametrize(
    ("seconds", "texts"),
    [
        (2, ["23:13:20.0", "23:13:20.5", "23:13:21.0", "23:13:21.5", "23:13:22.0"]),
        (9000, ["23:30:00", "00:00:00", "00:30:00", "01:00:00", "01:30:00"]),
        (0.004, ["23:13:20.000", "23:13:20.001", "23:13:20.002", "23:13:20.003", "23:13:20.004"]),
    ],
)
def test_times_on_the_axis_are_round_local_times(seconds: float, texts: list[str]) -> None:
    axis = TimeAxis(T0, T0 + round(seconds * S), is_relative=False)
    assert [tick.text for tick in time_ticks(axis, 5)] == texts


def test_times_of_several_recordings_are_seconds() -> None:
    found = time_ticks(TimeAxis(0, 10 * S, is_relative=True), 5)
    assert [tick.text for tick in found] == ["0 s", "2 s", "4 s", "6 s", "8 s", "10 s"]


def test_values_of_one_unit_share_a_panel() -> None:
    found = panels_of([
        series(1, 2, unit="°C"),
        series(0, 1, is_step=True),
        series(5, 9, unit="°C"),
        series(3, 3, unit="bar"),
    ])  # fmt: skip
    assert [(panel.unit, len(panel.series)) for panel in found] == [("°C", 2), ("", 1), ("bar", 1)]
    assert found[0].low < 1
    assert found[0].high > 9
    assert found[2].low < 3 < found[2].high


def test_braille_draws_a_diagonal_from_corner_to_corner() -> None:
    found = series(0, 1)
    axis = time_axis([found], is_relative=False)
    assert axis is not None
    (panel,) = panels_of([found])
    panel = panel._replace(low=0, high=1)
    rows = braille([found], panel, axis, 4, 2)
    text = ["".join(sign for sign, _ in row) for row in rows]
    assert text == ["  ⣠⠞", "⣠⠞  "] or (text[0][-1] != " " and text[1][0] != " ")
    assert text[0][0] == text[1][-1] == " "


def test_infinite_values_end_at_the_edge() -> None:
    found = series(0, math.inf, 1)
    axis = time_axis([found], is_relative=False)
    assert axis is not None
    drawing = draw("t", [found], axis, 400, 200)
    assert all(0 <= y <= 200 for path in drawing.paths for _, y in path.points)


def test_nothing_to_draw_is_an_error(tmp_path: Path) -> None:
    path = write_values(tmp_path / "a.mcap", 3)
    with pytest.raises(ConfigError, match="texts and bytes are not drawn"):
        series_of_files([path], ["island-01/name"], begin=None, end=None, plant=None)
    with pytest.raises(ConfigError, match="no value in that time"):
        series_of_files([path], ["temp"], begin="+5s", end=None, plant=None)


def test_several_recordings_begin_at_zero(tmp_path: Path) -> None:
    files = [write_values(tmp_path / f"{name}.mcap", 5) for name in "ab"]
    found, axis = series_of_files(files, ["island-01/temp"], begin="+10ms", end=None, plant=None)
    assert [each.name for each in found] == ["a: island-01/temp", "b: island-01/temp"]
    assert [list(each.times) for each in found] == [[n * CYCLE_NS for n in range(4)]] * 2
    assert (axis.from_ns, axis.is_relative) == (0, True)


def test_pictures_of_every_form_are_whole(tmp_path: Path) -> None:
    path = write_values(tmp_path / "a.mcap")
    found, axis = series_of_files([path], ["island-01"], begin=None, end=None, plant=None)
    found[0].name = "</script><b>&"
    for suffix in ("svg", "html", "png"):
        write_chart(tmp_path / f"x.{suffix}", "a <title>", found, axis)
    root = fromstring((tmp_path / "x.svg").read_text())
    paths = root.findall("{http://www.w3.org/2000/svg}path")
    assert len(paths) == len(found) == 7
    page = (tmp_path / "x.html").read_text()
    assert "</script><b>" not in page
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")
    with Image.open(BytesIO((tmp_path / "x.png").read_bytes())) as picture:
        assert picture.size == (2000, 1680)
        assert len(picture.getcolors(1 << 20) or ()) > 10
    with pytest.raises(ConfigError, match=r"\.jpg is no form of a chart"):
        write_chart(tmp_path / "x.jpg", "t", found, axis)
