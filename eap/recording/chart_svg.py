"""Charts as SVG and as pages of HTML that need nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import msgspec

from eap.recording.chart import COLORS, Drawing, TimeAxis
from eap.recording.series import Series, lines

_STYLE = """
svg { font: 12px system-ui, sans-serif; background: #fff; }
text { fill: #222; }
.grid { stroke: #ddd; }
.axis { stroke: #666; }
path { fill: none; stroke-width: 1.4; stroke-linejoin: round; }
@media (prefers-color-scheme: dark) {
  svg { background: #1b1d1f; }
  text { fill: #ddd; }
  .grid { stroke: #3a3d40; }
  .axis { stroke: #999; }
}
"""
_PAGE_POINTS = 2000
"""Columns of the values that a page has for its cursor."""


def to_svg(drawing: Drawing) -> str:
    """Return the text of an SVG file."""
    width, height = drawing.width, drawing.height
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}"'
            f' viewBox="0 0 {width} {height}" role="img">'
        ),
        f"<title>{escape(drawing.texts[0].text)}</title>",
        f"<style>{_STYLE}{_colors()}</style>",
    ]
    parts += (
        f'<line class="{each.kind}" x1="{each.x1:.1f}" y1="{each.y1:.1f}" x2="{each.x2:.1f}"'
        f' y2="{each.y2:.1f}"/>'
        for each in drawing.lines
    )
    for path in drawing.paths:
        points = "L".join(f"{x:.1f} {y:.1f}" for x, y in path.points)
        parts.append(f'<path class="s{path.color % len(COLORS)}" d="M{points}"/>')
    for text in drawing.texts:
        color = "" if text.color is None else f' class="t{text.color % len(COLORS)}"'
        parts.append(
            f'<text x="{text.x:.1f}" y="{text.y:.1f}" text-anchor="{text.anchor}"{color}>'
            f"{escape(text.text)}</text>"
        )
    return "\n".join((*parts, "</svg>", ""))


def _colors() -> str:
    return "".join(
        f".s{number} {{ stroke: {color}; }} .t{number} {{ fill: {color}; font-weight: 600; }}\n"
        for number, color in enumerate(COLORS)
    )


_SCRIPT = """
const data = JSON.parse(document.getElementById("data").textContent);
const svg = document.querySelector("svg"), out = document.querySelector("output");
const box = svg.viewBox.baseVal, left = 72, right = 16;
const cursor = document.createElementNS(svg.namespaceURI, "line");
cursor.setAttribute("class", "axis");
svg.append(cursor);
function at(points, x) {
  let low = 0, high = points.length - 1;
  if (high < 0 || x < points[0][0]) return null;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (points[middle][0] <= x) low = middle; else high = middle - 1;
  }
  return points[low][1];
}
svg.addEventListener("pointermove", event => {
  const place = svg.getBoundingClientRect();
  const x = (event.clientX - place.left) / place.width * box.width;
  const share = Math.min(Math.max((x - left) / (box.width - left - right), 0), 1);
  for (const [name, value] of [["x1", x], ["x2", x], ["y1", 34], ["y2", box.height - 30]])
    cursor.setAttribute(name, value);
  const seconds = share * data.seconds;
  const time = data.start === null ? seconds.toFixed(3) + " s"
    : new Date(data.start + seconds * 1000).toISOString();
  const values = data.series.map(each => {
    const value = at(each.points, share);
    const text = value === null ? "-" : Number(value.toPrecision(7)) + " " + each.unit;
    return each.name + " " + text;
  });
  out.textContent = [time, ...values].join("   ");
});
"""


def to_html(drawing: Drawing, series: Sequence[Series], axis: TimeAxis) -> str:
    """Return a page with the chart; a cursor shows time and values below it."""
    data = {
        "start": None if axis.is_relative else axis.from_ns / 1e6,
        "seconds": (axis.until_ns - axis.from_ns) / 1e9,
        "series": [
            {
                "name": each.name,
                "unit": each.unit,
                "points": [
                    (
                        point.x / _PAGE_POINTS,
                        point.value if point.value - point.value == 0 else None,
                    )
                    for line in lines(each, axis.from_ns, axis.until_ns, _PAGE_POINTS)
                    for point in line
                ],
            }
            for each in series
        ],
    }
    # Within a script element, a name with </script> in it would end it.
    text = msgspec.json.encode(data).decode().replace("<", "\\u003c")
    title = escape(drawing.texts[0].text)
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ margin: 1em; font: 14px system-ui, sans-serif; color-scheme: light dark; }}
svg {{ width: 100%; height: auto; }}
output {{ white-space: pre-wrap; }}
</style>
{to_svg(drawing)}
<output>Move over the chart to read values.</output>
<script type="application/json" id="data">{text}</script>
<script>{_SCRIPT}</script>
</html>
"""
