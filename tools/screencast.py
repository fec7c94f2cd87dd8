"""Record a terminal program as an animated SVG, such as the picture in README.md.

    python -m tools.screencast docs/pictures/demo.svg --skip 6 --seconds 10 -- make demo

The program runs in tmux with 80 columns and 24 lines, and is captured at intervals.  Lines that are
the same all the time are drawn once; the others change by CSS, which browsers animate in an
``<img>`` as well.  The program is ended with Ctrl-C.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from uuid import uuid4

from rich.style import Style
from rich.terminal_theme import MONOKAI
from rich.text import Text

COLUMNS, LINES = 80, 24
_WIDTH, _HEIGHT, _MARGIN = 8.4, 18, 12
"""Pixels of a character, a line, and around all of them."""
_FRAME = '<g class="f" style="animation-delay:{delay:.2f}s">{lines}</g>'


def record(command: Sequence[str], *, skip_s: float, seconds: float, period_s: float) -> list[str]:
    """Run a program in tmux; return its screens, with their escape sequences.

    Args:
        command: Program and arguments.
        skip_s: Time before the first screen.
        seconds: Time from the first screen to the last one.
        period_s: Time from one screen to the next.

    Raises:
        CalledProcessError: tmux is missing, or the program has ended.
    """
    tmux = ["tmux", "-L", f"screencast-{uuid4().hex}"]
    size = ["-x", str(COLUMNS), "-y", str(LINES)]
    subprocess.run([*tmux, "-f", "/dev/null", "new-session", "-d", *size, *command], check=True)
    try:
        _wait(skip_s)
        screens = []
        for _ in range(round(seconds / period_s)):
            captured = subprocess.run(
                [*tmux, "capture-pane", "-ep"], check=True, capture_output=True, text=True
            )
            screens.append(captured.stdout)
            _wait(period_s)
    finally:
        subprocess.run([*tmux, "send-keys", "C-c"], check=False)
        _wait(1.0)
        subprocess.run([*tmux, "kill-server"], check=False, capture_output=True)
    return screens


def _wait(seconds: float) -> None:
    time.sleep(seconds)  # noqa: TID251  a recording takes the time that it shows


def draw(screens: Sequence[str], period_s: float) -> str:
    """Return an SVG document that shows the screens in turn, *period_s* each."""
    rows = [Text.from_ansi(screen).split(allow_blank=True) for screen in screens]
    count = max(len(each) for each in rows)
    lines = [[each[at] if at < len(each) else Text() for each in rows] for at in range(count)]
    is_still = [all(each == line[0] for each in line) for line in lines]
    still = "".join(_row(line[0], at) for at, line in enumerate(lines) if is_still[at])
    moving = "".join(
        _FRAME.format(
            delay=number * period_s,
            lines="".join(
                _row(line[number], at) for at, line in enumerate(lines) if not is_still[at]
            ),
        )
        for number in range(len(screens))
    )
    total_s = period_s * len(screens)
    width = COLUMNS * _WIDTH + 2 * _MARGIN
    height = count * _HEIGHT + 2 * _MARGIN
    theme = MONOKAI
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height}">'
        "<style>text{font:14px ui-monospace,Menlo,Consolas,'DejaVu Sans Mono',monospace;"
        f"white-space:pre;fill:{theme.foreground_color.hex}}}"
        f".f{{visibility:hidden;animation:show {total_s:.2f}s steps(1) infinite}}"
        f"@keyframes show{{0%{{visibility:visible}}{100 / len(screens):.4f}%{{visibility:hidden}}}}"
        "</style>"
        f'<rect width="100%" height="100%" rx="8" fill="{theme.background_color.hex}"/>'
        f"{still}{moving}</svg>\n"
    )


def _row(line: Text, number: int) -> str:
    """Return a line of the screen: each of its pieces at its own column, whatever the font."""
    y = _MARGIN + (number + 0.75) * _HEIGHT
    return "".join(
        f'<text x="{_MARGIN + column * _WIDTH:.1f}" y="{y:.1f}"'
        f' textLength="{len(text) * _WIDTH:.1f}"{_attributes(style)}>{escape(text)}</text>'
        for column, text, style in _pieces(line)
    )


def _pieces(line: Text) -> Iterator[tuple[int, str, Style]]:
    """Yield the runs of one style without the blanks around them, with their columns."""
    column = 0
    for text, style in _runs(line):
        word = text.strip()
        if word:
            yield column + text.index(word), word, style
        column += len(text)


def _runs(line: Text) -> Iterable[tuple[str, Style]]:
    bounds = sorted({0, len(line), *(at for span in line.spans for at in (span.start, span.end))})
    for start, end in pairwise(bounds):
        styles = [span.style for span in line.spans if span.start <= start < span.end]
        combined = Style.combine([Style(), *(each for each in styles if isinstance(each, Style))])
        yield line.plain[start:end], combined


def _attributes(style: Style) -> str:
    fill = f' fill="{style.color.get_truecolor(MONOKAI).hex}"' if style.color else ""
    weight = ' font-weight="bold"' if style.bold else ""
    opacity = ' opacity="0.6"' if style.dim else ""
    return fill + weight + opacity


def main() -> None:
    """Record what the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--skip", type=float, default=5.0, help="seconds before the first screen")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--period", type=float, default=1.0, help="seconds between two screens")
    parser.add_argument("command", nargs="+")
    wanted = parser.parse_args()
    screens = record(
        wanted.command, skip_s=wanted.skip, seconds=wanted.seconds, period_s=wanted.period
    )
    wanted.picture.parent.mkdir(parents=True, exist_ok=True)
    wanted.picture.write_text(draw(screens, wanted.period))


if __name__ == "__main__":
    main()
