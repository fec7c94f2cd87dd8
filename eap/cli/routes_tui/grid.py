"""The table of the live view as a widget: it changes what has changed, and keeps its cursor."""

from __future__ import annotations

from collections.abc import Sequence

from rich.text import Text
from textual.widgets import DataTable

from eap.cli.routes_tui.table import GridColumn, Line, View, cut, fit

STYLES = {
    "up": "green",
    "down": "bold red",
    "unknown": "dim",
    "client": "dim",
    "bold": "bold",
    "": "",
}
"""How texts are coloured, by what they say."""


class Grid(DataTable[Text]):
    """Lines of a view, one of them chosen."""

    def __init__(self, name: str) -> None:
        super().__init__(id=name, cursor_type="row", cell_padding=0)
        self._lines: Sequence[Line] = ()
        self._fitted: list[tuple[int, GridColumn, int]] = []

    @property
    def chosen(self) -> Line | None:
        """The line that the cursor is on."""
        at = self.cursor_row
        return self._lines[at] if 0 <= at < len(self._lines) else None

    def show_lines(
        self, view: View, found: Sequence[Line], width: int, *, has_station: bool
    ) -> None:
        """Show *found* in *width* characters; the cursor stays on its line if that is there."""
        fitted = fit(view, found, width, has_station=has_station)
        before, chosen = [line.key for line in self._lines], self.chosen
        self._lines = found
        cells = [
            [
                Text(cut(line.cells[number], size, is_number=column.is_number),
                     style=STYLES[line.state] if column.heading == "State" else "")
                for number, column, size in fitted
            ]
            for line in found
        ]  # fmt: skip
        if (fitted, [line.key for line in found]) != (self._fitted, before):
            self._fitted = fitted
            self._lay_out(cells, chosen)
            return
        for number, row in enumerate(cells):
            for place, cell in enumerate(row):
                if self.get_cell_at((number, place)) != cell:  # type: ignore[arg-type]
                    self.update_cell_at((number, place), cell)  # type: ignore[arg-type]

    def _lay_out(self, cells: list[list[Text]], chosen: Line | None) -> None:
        at = max(self.cursor_row, 0)
        self.clear(columns=True)
        for _, column, size in self._fitted:
            heading = cut(column.heading, size, is_number=column.is_number)
            self.add_column(Text(heading, style="bold"), width=size + 1)
        self.add_rows(cells)
        keys = [line.key for line in self._lines]
        if chosen is not None and chosen.key in keys:
            at = keys.index(chosen.key)
        self.move_cursor(row=max(min(at, len(keys) - 1), 0))
