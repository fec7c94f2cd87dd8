"""The application of ``eapctl top``: its views, and the requests that keep them current."""

from __future__ import annotations

import asyncio
from typing import ClassVar

from textual import work
from textual.app import App
from textual.binding import Binding, BindingType

from eap.cli.dialogs import Message
from eap.cli.routes_tui.app import RoutesScreen
from eap.cli.routes_tui.table import RouteRequests
from eap.cli.top_model import Tab, TopModel
from eap.cli.top_tui.overview import HELP, OverviewScreen
from eap.control.protocol import PD_LIST, READ
from eap.errors import EapError
from eap.live.client import LiveClient
from eap.live.rows import PdFlow
from eap.live.view import LiveView
from eap.pd.report import PdRow

PERIODS_S = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Periods of refreshes that keys choose among."""
READ_ONLY = "This view only shows: start it with --write to change routes and to record."
_LOOK_S = 0.5
"""Period in which events are looked for, where the screen is refreshed less often."""


class TopApp(App[None]):
    """Live overview of running plants.

    Args:
        view: Source of the reports.
        model: Content of the tables.
        routes: Requests of the view of routes.
        tab: View to begin with.
        period_s: Period of refreshes.
        routes_period_s: Period of requests of the view of routes.
        refusal: Why no routes are changed here; empty if they are.
        record_refusal: The same for recordings.
    """

    CSS_PATH = "style.tcss"
    ENABLE_COMMAND_PALETTE = False
    TITLE = "eapctl top"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("1", "tab('stations')", "View", key_display="1-5"),
        Binding("2", "tab('pds')", "PDs", show=False),
        Binding("3", "tab('buses')", "Buses", show=False),
        Binding("4", "tab('routes')", "Routes", show=False),
        Binding("5", "tab('events')", "Events", show=False),
        Binding("plus,equals_sign", "rate(-1)", "Faster", show=False),
        Binding("minus", "rate(1)", "Slower", show=False),
        Binding("q,ctrl+c", "quit", "Quit", key_display="q"),
    ]

    def __init__(
        self,
        view: LiveView,
        model: TopModel,
        routes: RouteRequests,
        *,
        tab: Tab = Tab.STATIONS,
        period_s: float = 1.0,
        routes_period_s: float = 1.0,
        refusal: str = READ_ONLY,
        record_refusal: str = READ_ONLY,
    ) -> None:
        super().__init__()
        self._live = view
        self._period_s = period_s
        self._first_tab = tab
        self._overview = OverviewScreen(model, view.log.events, record_refusal)
        self._routes = RoutesScreen(routes, period_s=routes_period_s, refusal=refusal)
        self._model = model
        self._pds: dict[tuple[str, str], list[PdRow]] = {}
        self._is_polling = False
        self._changed = asyncio.Event()

    def on_mount(self) -> None:
        """Show the first view."""
        self.install_screen(self._overview, "overview")
        self.install_screen(self._routes, "routes")
        if self._first_tab is Tab.ROUTES:
            self.push_screen("routes")
        else:
            self.push_screen("overview")
            self._overview.tab = self._first_tab
            self._begin()
        self._overview.show_period(self._period_s)

    async def on_unmount(self) -> None:
        """Close the connections."""
        await self._live.close()

    def action_tab(self, name: str) -> None:
        """Show another view."""
        tab = Tab(name)
        wanted = "routes" if tab is Tab.ROUTES else "overview"
        screens = {"routes": self._routes, "overview": self._overview}
        if self.screen is not screens[wanted]:
            self.switch_screen(wanted)
        if tab is not Tab.ROUTES:
            self._overview.show_tab(tab)
            self._begin()

    def action_rate(self, step: int) -> None:
        """Refresh more often or less often."""
        nearest = min(range(len(PERIODS_S)), key=lambda at: abs(PERIODS_S[at] - self._period_s))
        self._period_s = PERIODS_S[min(max(nearest + step, 0), len(PERIODS_S) - 1)]
        self._overview.show_period(self._period_s)
        self._changed.set()

    def action_help(self) -> None:
        """Show what each key does."""
        self.push_screen(Message("Keys", HELP))

    def _begin(self) -> None:
        """Begin to request reports: not before a view needs them."""
        if not self._is_polling:
            self._is_polling = True
            self._poll()

    @work
    async def _poll(self) -> None:
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            began_s = clock()
            report = await self._live.take()
            # What happens is shown before the next refresh is due.
            if began_s >= due_s or report.events:
                self._model.take(report)
                await self._read_values()
                self._overview.refresh_rows()
                due_s = began_s + self._period_s
            self._changed.clear()
            next_s = min(due_s, began_s + max(_LOOK_S, self._period_s / 2))
            try:
                async with asyncio.timeout(max(next_s - clock(), 0.02)):
                    await self._changed.wait()
                due_s = clock()
            except TimeoutError:
                continue

    async def _read_values(self) -> None:
        """Read the values of the PD that is chosen."""
        line = self._overview.chosen if self._overview.tab is Tab.PDS else None
        if line is None or not isinstance(line.row, PdFlow):
            return
        row = line.row
        try:
            client = self._live.client_of(row.plant, row.station)
            names = await self._variables_of(client, row)
            params = {"station": row.station, "names": names}
            values = READ.decode(await client.request(READ.name, within_s=1.0, **params)).values
        except EapError as exc:
            self._overview.values = str(exc)
        else:
            self._overview.values = values if names else {}

    async def _variables_of(self, client: LiveClient, row: PdFlow) -> list[str]:
        key, wanted = (row.plant, row.station), (row.direction, row.name)
        rows = {(each.direction, each.name): each for each in self._pds.get(key, ())}
        # Asked once: another configuration of the station has other PDs.
        if wanted not in rows:
            self._pds[key] = await client.call(PD_LIST, station=row.station, within_s=1.0)
            rows = {(each.direction, each.name): each for each in self._pds[key]}
        return [each.name for each in rows[wanted].variables] if wanted in rows else []
