"""Table of a live view, which fits its columns to the screen and keeps its cursor.

The functions that fit are pure: columns and texts in, widths out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

from rich.text import Text
from textual.widgets import DataTable

_GAP = 1
_EXTRA = 6
"""Columns from this rank on are shown only where no text has to be cut for them."""
_READABLE = 12
"""A text is not cut to less than that while another column can be left out."""


class GridColumn(NamedTuple):
    """A column.

    Attributes:
        heading: Above it.
        least: Minimum width.
        most: Maximum width; 0 uses the rest.
        is_number: It is aligned to the right.
        rank: 0 is always shown; a narrow screen omits the highest rank first.
    """

    heading: str
    least: int
    most: int
    is_number: bool = False
    rank: int = 0


class GridLine(Protocol):
    """A row of a table."""

    @property
    def key(self) -> str:
        """Identity of the row: the cursor stays on it while others come and go."""

    @property
    def cells(self) -> tuple[str, ...]:
        """Its texts, by the number of their column."""

    def style_of(self, number: int) -> str:
        """Return the style of a text, empty for none."""


LineT = TypeVar("LineT", bound=GridLine)


def fit(
    columns: Mapping[int, GridColumn], found: Sequence[GridLine], width: int
) -> list[tuple[int, GridColumn, int]]:
    """Return number, column and width of those of *columns* that fit in *width* characters.

    Columns are as wide as they need to be.  Where that is too wide, extra columns are left out, and
    then long texts give way, the longest first; but before they become unreadable, more columns are
    left out, those of the highest rank first.
    """
    chosen = dict(columns)
    while (sizes := _sizes(chosen, found)) and _total(sizes.values()) > width:
        worst = max(chosen, key=lambda number: chosen[number].rank)
        rank = chosen[worst].rank
        is_readable = _total(min(size, _READABLE) for size in sizes.values()) <= width
        if not rank or (rank < _EXTRA and is_readable):
            break
        del chosen[worst]
    while (excess := _total(sizes.values()) - width) > 0:
        spare = {number: size - chosen[number].least for number, size in sizes.items()}
        widest = max(spare, key=lambda number: (spare[number], sizes[number]))
        if spare[widest] <= 0:
            break
        sizes[widest] -= 1
    last = next(reversed(chosen))
    if not chosen[last].most and excess < 0:
        sizes[last] -= excess
    return [(number, column, sizes[number]) for number, column in chosen.items()]


def _sizes(chosen: Mapping[int, GridColumn], found: Sequence[GridLine]) -> dict[int, int]:
    """Return the width that each column needs, between its bounds."""
    sizes = {}
    for number, column in chosen.items():
        needed = max((len(line.cells[number]) for line in found), default=0)
        needed = max(needed, len(column.heading), column.least if column.is_number else 0)
        sizes[number] = min(needed, column.most) if column.most else column.least
    return sizes


def _total(sizes: Iterable[int]) -> int:
    return sum(size + _GAP for size in sizes)


def cut(text: str, size: int, *, is_number: bool) -> str:
    """Return *text* in *size* characters."""
    if len(text) > size:
        text = f"{text[: size - 1]}…"
    return text.rjust(size) if is_number else text


class Grid(DataTable[Text], Generic[LineT]):
    """Lines of a view, one of them chosen."""

    def __init__(self, name: str) -> None:
        super().__init__(id=name, cursor_type="row", cell_padding=0)
        self._lines: Sequence[LineT] = ()
        self._fitted: list[tuple[int, GridColumn, int]] = []

    @property
    def chosen(self) -> LineT | None:
        """The line that the cursor is on."""
        at = self.cursor_row
        return self._lines[at] if 0 <= at < len(self._lines) else None

    def show_lines(
        self, columns: Mapping[int, GridColumn], found: Sequence[LineT], width: int
    ) -> None:
        """Show *found* in *width* characters; the cursor stays on its line if that is there."""
        fitted = fit(columns, found, width)
        before, chosen = [line.key for line in self._lines], self.chosen
        self._lines = found
        cells = [
            [
                Text(
                    cut(line.cells[number], size, is_number=column.is_number),
                    style=line.style_of(number),
                )
                for number, column, size in fitted
            ]
            for line in found
        ]
        # Rebuilding moves cursor and scroll position; usually only cells have changed.
        if (fitted, [line.key for line in found]) != (self._fitted, before):
            self._fitted = fitted
            self._lay_out(cells, chosen)
            return
        for number, row in enumerate(cells):
            for place, cell in enumerate(row):
                if self.get_cell_at((number, place)) != cell:  # type: ignore[arg-type]
                    self.update_cell_at((number, place), cell)  # type: ignore[arg-type]

    def _lay_out(self, cells: list[list[Text]], chosen: LineT | None) -> None:
        at = max(self.cursor_row, 0)
        self.clear(columns=True)
        for _, column, size in self._fitted:
            heading = cut(column.heading, size, is_number=column.is_number)
            self.add_column(Text(heading, style="bold"), width=size + 1)
        self.add_rows(cells)
        # By key and not by number: the cursor stays on its route when others come and go.
        keys = [line.key for line in self._lines]
        if chosen is not None and chosen.key in keys:
            at = keys.index(chosen.key)
        self.move_cursor(row=max(min(at, len(keys) - 1), 0))
