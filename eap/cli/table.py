"""Parts of the text view of a command: tables, styled text, numbers in words.

A table leaves out columns before it breaks a word.  Each column has a rank.  Where the table is
wider than the screen, the columns of the highest rank go first, and a line below the table names
them.  Columns that wrap give way only at spaces.  Piped output has no width, so that nothing is
left out there (eap/cli/output.py).

Rich is imported when something is rendered: a command with ``--json`` never waits for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.text import Text

QUALITY_MAX = 0xFFFF
"""Saturation value of a quality: 6.5535 s."""

_GAP = 2
"""Spaces between two columns: what rich puts there for one space of padding and no border."""
_LEAST_WRAPPED = 16
"""A column that wraps is not made narrower than this while another one can be left out."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Attributes:
        heading: Its words above the rows.
        rank: 0 is always shown; where there is no room, the highest rank is left out first.
        is_number: Whether its cells are aligned to the right.
        wraps: Whether its cells may take several lines, broken at spaces.
    """

    heading: str
    rank: int = 0
    is_number: bool = False
    wraps: bool = False


class Styled:
    """Text with a style for each of its parts, such as ``bold red``."""

    def __init__(self, text: str = "", style: str = "") -> None:
        self._whole_style = style
        self._parts: list[tuple[str, str]] = [(text, "")]

    @property
    def plain(self) -> str:
        """The text without its styles."""
        return "".join(text for text, _ in self._parts)

    @property
    def style(self) -> str:
        """Style of the whole text."""
        return self._whole_style

    def append(self, text: str, style: str = "") -> Self:
        """Add *text* in a style of its own."""
        self._parts.append((text, style))
        return self

    def __rich__(self) -> Text:
        from rich.text import Text

        whole = Text(style=self._whole_style)
        for text, style in self._parts:
            whole.append(text, style or None)
        return whole


class TextTable:
    """Rows below headings, as wide as they need and at most as wide as the screen."""

    def __init__(self, *columns: Column | str) -> None:
        self._columns = [Column(each) if isinstance(each, str) else each for each in columns]
        self._rows: list[list[Styled]] = []

    def add_row(self, *cells: str | Styled) -> None:
        """Add one row; cells that are not given are empty."""
        row = [Styled(cell) if isinstance(cell, str) else cell for cell in cells]
        self._rows.append(row + [Styled()] * (len(self._columns) - len(row)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich import box
        from rich.table import Table

        shown = self._fitting(options.max_width)
        widths = self._widths(shown, options.max_width)
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
        for at, width in zip(shown, widths, strict=True):
            column = self._columns[at]
            table.add_column(
                column.heading,
                width=width,
                justify="right" if column.is_number else "left",
                overflow="fold",
                vertical="top",
            )
        for row in self._rows:
            table.add_row(*(row[at] for at in shown))
        yield table
        if len(shown) < len(self._columns):
            left_out = (each.heading for at, each in enumerate(self._columns) if at not in shown)
            names = ", ".join(" ".join(heading.split()) for heading in left_out)
            yield Styled(f"not shown for lack of width: {names}", style="dim")

    def _fitting(self, room: int) -> list[int]:
        """Return the numbers of the columns for which there is *room* without breaking words."""
        shown = list(range(len(self._columns)))
        while _total(self._needs(at, "narrow") for at in shown) > room:
            worst = max(shown, key=lambda at: self._columns[at].rank)
            if not self._columns[worst].rank:
                break
            shown.remove(worst)
        return shown

    def _widths(self, shown: Sequence[int], room: int) -> list[int]:
        """Return the width of each column; those that wrap share what the others leave."""
        least = [self._needs(at, "narrow") for at in shown]
        widths = [self._needs(at, "wide") for at in shown]
        excess = _total(widths) - room
        while excess > 0:
            slack = [wide - narrow for wide, narrow in zip(widths, least, strict=True)]
            widest = max(range(len(shown)), key=lambda at: (slack[at] > 0, widths[at]))
            if not slack[widest]:
                least = [1] * len(shown)  # nothing fits: break words of the widest column
                if widths[widest] == 1:
                    break
                continue
            widths[widest] -= 1
            excess -= 1
        return widths

    def _needs(self, at: int, size: Literal["narrow", "wide"]) -> int:
        """Return the width of a column on one line a cell, or of its longest word if it wraps."""
        from rich.cells import cell_len

        column = self._columns[at]
        texts = [column.heading, *(row[at].plain for row in self._rows)]
        whole = max(cell_len(line) for text in texts for line in text.splitlines() or [""])
        if size == "wide" or not column.wraps:
            return whole
        word = max((cell_len(word) for text in texts for word in text.split()), default=0)
        return max(word, min(whole, _LEAST_WRAPPED))


def _total(widths: Iterable[int]) -> int:
    listed = list(widths)
    return sum(listed) + _GAP * (len(listed) - 1)


class ItemLine:
    """A heading and items behind it, with commas between them; a line ends between two items."""

    def __init__(self, heading: str, items: Sequence[Styled]) -> None:
        self._heading = heading
        self._items = items

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.text import Text

        line = Text(self._heading, style="bold")
        for number, item in enumerate(each.__rich__() for each in self._items):
            comma = "," if number + 1 < len(self._items) else ""
            if line.cell_len + item.cell_len + 1 + len(comma) > options.max_width:
                yield line
                line = Text(" " * len(self._heading))
            line.append(" ").append_text(item).append(comma, "none")
        yield line


def duration(us: int) -> str:
    """Return microseconds in the unit that keeps the number short."""
    if us < 1000:
        return f"{us} µs" if us else "0"
    if us < 1_000_000:
        return f"{us / 1000:.1f} ms"
    seconds = us / 1_000_000
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def quality(units: int | None) -> str:
    """Return a quality (in units of 100 us) as a time; empty while nothing was received."""
    if units is None:
        return ""
    return "> 6.5 s" if units == QUALITY_MAX else duration(units * 100)


def times(count: int) -> str:
    """Return a number of times in words."""
    return "once" if count == 1 else f"{count} times"


def count(number: int, thing: str) -> str:
    """Return *number* and *thing*, in singular or plural."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
