"""Charts as PNG, by Pillow, which is an extra of this project."""

from __future__ import annotations

from io import BytesIO

from eap.errors import EnvironmentalError
from eap.recording.chart import COLORS, Drawing

try:
    from PIL import Image as Picture
    from PIL import ImageDraw, ImageFont
except ImportError:
    raise EnvironmentalError(
        "PNG needs pillow, which is not installed: pip install 'eap-appliance[export]' (in the"
        " project's folder: pip install '.[export]'), or write SVG"
    ) from None

_SCALE = 2
"""Pixels of a unit, for sharp lines on every screen."""
_LINES = {"grid": "#dddddd", "axis": "#666666"}
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


def to_png(drawing: Drawing) -> bytes:
    """Return the bytes of a PNG file, on white."""
    picture = Picture.new("RGB", (drawing.width * _SCALE, drawing.height * _SCALE), "white")
    canvas = ImageDraw.Draw(picture)
    font = ImageFont.load_default(12 * _SCALE)
    for line in drawing.lines:
        ends = [each * _SCALE for each in (line.x1, line.y1, line.x2, line.y2)]
        canvas.line(ends, fill=_LINES[line.kind], width=_SCALE)
    for path in drawing.paths:
        points = [(x * _SCALE, y * _SCALE) for x, y in path.points]
        canvas.line(points, fill=COLORS[path.color % len(COLORS)], width=3, joint="curve")
    for text in drawing.texts:
        color = "#222222" if text.color is None else COLORS[text.color % len(COLORS)]
        place = (text.x * _SCALE, text.y * _SCALE)
        canvas.text(place, text.text, fill=color, font=font, anchor=_ANCHORS[text.anchor])
    out = BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()
