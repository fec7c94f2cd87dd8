"""Charts: what they show, their size, and that they are the same each time."""

from __future__ import annotations

from pathlib import Path

import pytest
from defusedxml.ElementTree import fromstring
from msgspec.json import encode
from msgspec.json import format as format_json
from msgspec.structs import replace

from tools.bench import __main__ as program
from tools.bench.charts import CHARTS, draw, write_charts
from tools.bench.figures import Bar, BarKind, Comparison, Figure

BARS = (Bar("ours", 50.0, BarKind.OURS), Bar("A & B", 100.0, BarKind.PEER),
        Bar("a C loop", 200.0, BarKind.LIMIT))  # fmt: skip
SHARED = next(chart for chart in CHARTS if chart.one_scale)
SVG = "{http://www.w3.org/2000/svg}"


def widths(picture: str, kind: str) -> list[int]:
    found = fromstring(picture).iter(f"{SVG}rect")
    return [int(each.get("width")) for each in found if each.get("class") == kind][1:]


def test_bars_are_as_long_as_their_values() -> None:
    picture = draw(SHARED, [Comparison("frames", "thousand/s", BARS)])
    ours, peer, limit = (widths(picture, kind)[0] for kind in "opm")
    assert (2 * ours, 2 * peer) == (peer, limit)
    texts = [each.text for each in fromstring(picture).iter(f"{SVG}text")]
    assert "A & B" in texts
    assert "50.0 thousand/s" in texts
    assert "target" not in texts


def test_comparisons_have_one_scale_or_their_own() -> None:
    small = Comparison("small", "%", tuple(Bar(b.name, b.value / 10, b.kind) for b in BARS))
    groups = [Comparison("large", "%", BARS), small]
    assert widths(draw(SHARED, groups), "m") == [420, 42]
    assert widths(draw(SHARED._replace(one_scale=False), groups), "m") == [420, 420]


@pytest.mark.parametrize(("target", "anchor"), [(60.0, "end"), (25.0, None), (190.0, None)])
def test_value_is_not_beside_the_mark_of_the_target(target: float, anchor: str | None) -> None:
    picture = draw(SHARED, [Comparison("frames", "MB/s", BARS, target)])
    (value,) = (t for t in fromstring(picture).iter(f"{SVG}text") if t.text == "50.0 MB/s")
    assert value.get("text-anchor") == anchor


def test_value_of_a_short_bar_is_behind_the_mark() -> None:
    bars = (Bar("ours", 4.0, BarKind.OURS), Bar("a C loop", 200.0, BarKind.LIMIT))
    picture = draw(SHARED, [Comparison("frames", "thousand/s", bars, 10.0)])
    texts, paths = ([*fromstring(picture).iter(SVG + each)] for each in ("text", "path"))
    (value,) = (each for each in texts if each.text == "4.00 thousand/s")
    (_, mark) = (each for each in paths if each.get("class") == "x")  # behind that of the legend
    assert int(value.get("x")) > int(mark.get("d")[1:].split()[0])


def test_charts_are_written_for_what_was_measured(tmp_path: Path) -> None:
    figure = Figure("a", "1").compared("frames", "thousand/s", BARS, 70.0)
    figures = {"throughput": [figure, Figure("b", "2")], "bus": [Figure("c", "3")]}
    for _ in range(2):
        (chart,) = write_charts(tmp_path, figures)
    assert chart.file == "bench-throughput.svg"
    (file,) = tmp_path.iterdir()
    assert file.read_text() == draw(chart, [Comparison("frames", "thousand/s", BARS, 70.0)])
    assert file.stat().st_size < 30_000


def test_report_is_read_back_without_a_measurement(tmp_path: Path, capsys) -> None:
    figure = Figure("frames", "1.1", limit="a C loop").compared("frames", "thousand/s", BARS)
    report = program.Report("here", False, [figure], [program.Section("bus", "Bus", [figure])])
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    first.write_bytes(format_json(encode(report)) + b"\n")
    newer = replace(report.sections[0], figures=[replace(figure, measured="1.2")])
    again = tmp_path / "again.json"
    again.write_bytes(encode(replace(report, sections=[newer])))
    words = ["--read", str(first), "--json", str(second), "--charts", str(tmp_path)]
    assert program.main(words) == 0
    assert second.read_bytes() == first.read_bytes()
    assert (tmp_path / "bench-bus.svg").exists()
    words[1:2] = [str(first), str(again)]
    assert program.main(words) == 0
    assert b'"measured": "1.2"' in second.read_bytes()
    assert b'"measured": "1.1"' not in second.read_bytes()
    assert "frames          1.1               a C loop" in capsys.readouterr().out
