from __future__ import annotations

from textual.app import App, ComposeResult

from eap.cli.routes_tui.table import PlantRouter, View, columns_of, lines
from eap.cli.top_tui.grid import Grid
from tests.support.fakeroutes import ISLAND, PRESS, FakeRoutes
from tests.support.virtualtime import run_virtual

COLUMNS = columns_of(View.ROUTES, has_station=True)


class Holder(App[None]):
    def compose(self) -> ComposeResult:
        yield Grid("grid")


def test_lines_change_in_place_and_the_cursor_follows_its_line() -> None:
    fake = FakeRoutes()

    def found():
        return lines(View.ROUTES, [PlantRouter("line", fake.stations["island-01"])], "")

    async def script() -> None:
        app = Holder()
        async with app.run_test(size=(80, 24)):
            grid = app.query_one(Grid)
            assert grid.chosen is None
            grid.show_lines(COLUMNS, [], 80)
            assert grid.chosen is None
            grid.show_lines(COLUMNS, found(), 80)
            grid.move_cursor(row=1)
            assert grid.chosen.row is PRESS
            fake.set_routes("island-01", PRESS, ISLAND)
            grid.show_lines(COLUMNS, found(), 80)
            assert (grid.cursor_row, grid.chosen.row) == (0, PRESS)
            fake.set_routes("island-01", ISLAND)
            grid.show_lines(COLUMNS, found(), 80)
            assert grid.chosen.row is ISLAND

    run_virtual(script())
