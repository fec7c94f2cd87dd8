"""Charts of a run as SVG: bars of ours, of peers and of the machine's limits, side by side.

The same figures give the same bytes.  A chart follows the colour scheme of the reader.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

from tools.bench.figures import Bar, BarKind, Comparison, Figure

_WIDTH, _LABELS, _BARS, _RIGHT = 760, 216, 420, 12
_TITLE, _LEGEND, _HEAD, _ROW, _GAP, _BAR = 26, 30, 26, 22, 12, 15
_LETTER = 8
"""Width of a letter, at most."""
_STYLE = """
text { font: 13px system-ui, "Segoe UI", "DejaVu Sans", sans-serif; fill: #1f2328; }
.t { font-size: 16px; font-weight: 600; }
.g { font-weight: 600; }
.s, .l { fill: #59636e; }
.i { fill: #ffffff; }
.o { fill: #0969da; } .p { fill: #afb8c1; } .m { fill: #d4a72c; }
.a { stroke: #59636e; } .x { stroke: #cf222e; stroke-width: 2; } .xt { fill: #cf222e; }
@media (prefers-color-scheme: dark) {
text { fill: #e6edf3; }
.s, .l { fill: #9198a1; }
.i { fill: #0d1117; }
.o { fill: #4493f8; } .p { fill: #656c76; } .m { fill: #bb8009; }
.a { stroke: #9198a1; } .x { stroke: #ff7b72; } .xt { fill: #ff7b72; }
}
"""
_CLASS = {BarKind.OURS: "o", BarKind.PEER: "p", BarKind.LIMIT: "m"}
_LEGEND_TEXT = {
    BarKind.OURS: "this project",
    BarKind.PEER: "peer",
    BarKind.LIMIT: "limit: raw loop",
}


class Chart(NamedTuple):
    """One picture.

    Attributes:
        name: Of its file.
        title: Its heading.
        benchmarks: Those whose comparisons it shows, in their order.
        less: Whether the shorter bar is better.
        one_scale: Whether all comparisons have one scale, otherwise each its own.
    """

    name: str
    title: str
    benchmarks: tuple[str, ...]
    less: bool = False
    one_scale: bool = True

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"bench-{self.name}.svg"


CHARTS = (
    Chart("throughput", "Frames a second through the whole path", ("throughput",)),
    Chart("latency", "One-way latency of 600 bytes at 1 kHz, median", ("latency",), less=True),
    Chart(
        "requests", "Requests a second, one client", ("ads", "gateway", "requests"), one_scale=False
    ),
    Chart("bus", "Bus cycles a second, 16 slaves, 512 bytes", ("bus",), one_scale=False),
    Chart("share", "Share of a core", ("onestation", "solar", "demo"), less=True),
)


def write_charts(folder: Path, figures: Mapping[str, Sequence[Figure]]) -> list[Chart]:
    """Write the charts that *figures*, by benchmark, have bars for; return these."""
    written = []
    for chart in CHARTS:
        groups = [
            figure.comparison
            for name in chart.benchmarks
            for figure in figures.get(name, ())
            if figure.comparison is not None
        ]
        if groups:
            (folder / chart.file).write_text(draw(chart, groups), encoding="utf-8")
            written.append(chart)
    return written


def draw(chart: Chart, groups: Sequence[Comparison]) -> str:
    """Return the picture of *groups*."""
    scales = [max([*(bar.value for bar in each.bars), each.target or 0]) or 1 for each in groups]
    if chart.one_scale:
        scales = [max(scales)] * len(groups)
    better = "shorter is better" if chart.less else "longer is better"
    y = _TITLE
    body = [_text(0, y, chart.title, "t"), _text(_WIDTH - _RIGHT, y, better, "s", "end")]
    y += _LEGEND
    body += _legend(y, groups)
    y += _GAP
    for group, longest in zip(groups, scales, strict=True):
        body += _group(y, group, longest)
        y += _HEAD + _ROW * len(group.bars) + _GAP
    says = "; ".join(
        f"{group.title}: " + ", ".join(f"{bar.name} {_number(bar.value)}" for bar in group.bars)
        for group in groups
    )
    box = f'viewBox="0 0 {_WIDTH} {y}" role="img" aria-label="{escape(chart.title)}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {box}>'
    described = f"<desc>{escape(says)}</desc>"
    return "\n".join([head, described, f"<style>{_STYLE}</style>", *body, "</svg>\n"])


def _legend(y: int, groups: Sequence[Comparison]) -> Iterable[str]:
    kinds = {bar.kind for group in groups for bar in group.bars}
    x = 0
    for kind, text in _LEGEND_TEXT.items():
        if kind in kinds:
            yield f'<rect class="{_CLASS[kind]}" x="{x}" y="{y - 11}" width="12" height="12"/>'
            yield _text(x + 18, y, text, "l")
            x += 46 + 7 * len(text)
    if any(group.target is not None for group in groups):
        yield f'<path class="x" d="M{x + 6} {y - 13}v16"/>'
        yield _text(x + 18, y, "target", "l")


def _group(y: int, group: Comparison, longest: float) -> Iterable[str]:
    yield _text(0, y + 16, group.title, "g")
    top = y + _HEAD
    yield f'<path class="a" d="M{_LABELS} {top - 2}v{_ROW * len(group.bars)}"/>'
    for number, bar in enumerate(group.bars):
        line = top + number * _ROW
        width = _length(bar, longest)
        yield _text(_LABELS - 8, line + 12, bar.name, "", "end")
        place = f'x="{_LABELS}" y="{line}" width="{width}" height="{_BAR}"'
        yield f'<rect class="{_CLASS[bar.kind]}" {place}/>'
        at = _LABELS + width + 6
        text = f"{_number(bar.value)} {group.unit}"
        if group.target is not None and bar.kind is BarKind.OURS:
            x = _LABELS + round(_BARS * group.target / longest)
            yield f'<path class="x" d="M{x} {line - 3}v{_BAR + 6}"/>'
            space = _LETTER * len(text)
            if at - 6 <= x < at + space and width > space:
                # Beside the mark it would be taken for the target.
                yield _text(at - 12, line + 12, text, "i", "end")
                continue
            at = x + 6 if at - 6 <= x < at + space else at
        yield _text(at, line + 12, text, "s")


def _length(bar: Bar, longest: float) -> int:
    return max(round(_BARS * bar.value / longest), 1)


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _text(x: int, y: int, text: str, kind: str, anchor: str = "") -> str:
    attributes = f' class="{kind}"' if kind else ""
    attributes += f' text-anchor="{anchor}"' if anchor else ""
    return f'<text x="{x}" y="{y}"{attributes}>{escape(text)}</text>'
