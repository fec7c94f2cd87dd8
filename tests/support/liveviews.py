"""Applications of the live view for tests: reports that a test makes, and periods without end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from eap.cli.routes_tui.table import RouterClient, RouteRequests
from eap.cli.top_model import Tab, TopModel
from eap.cli.top_tui.app import TopApp
from eap.live.view import LiveReport, LiveView
from tests.support.statusdocument import NOW_S, with_findings

NEVER_S = 1000.0
"""Period of a view that looks only when it is told to."""
SECOND_NS = 1_000_000_000


def report(
    status: dict[str, Any], number: int = 0, unreachable: dict[str, str] | None = None
) -> LiveReport:
    """Return the report of a status document, *number* seconds after the first."""
    return LiveReport(
        at_ns=number * SECOND_NS,
        time=NOW_S + number,
        status=with_findings(status),
        unreachable=unreachable or {},
        events=[],
    )


class FakeView(LiveView):
    """Takes the reports of a test, a second apart; the last one stays."""

    def __init__(self, make: Callable[[int], dict[str, Any]]) -> None:
        super().__init__()
        self.unreachable: dict[str, str] = {}
        self._make = make
        self._number = 0

    async def take(self, *, within_s: float | None = None) -> LiveReport:
        """Return the next report."""
        del within_s
        found = report(self._make(self._number), self._number, self.unreachable)
        self._number += 1
        events = self.log.take(found.status, found.at_ns, found.time, found.unreachable)
        return msgspec.structs.replace(found, events=events)


def routes_app(requests: RouteRequests, period_s: float = NEVER_S, refusal: str = "") -> TopApp:
    """Return the live view, which begins with routes."""
    return TopApp(
        LiveView(),
        TopModel(),
        requests,
        tab=Tab.ROUTES,
        routes_period_s=period_s,
        refusal=refusal,
    )


def top_app(make: Callable[[int], dict[str, Any]], period_s: float = NEVER_S) -> TopApp:
    """Return the live view of reports that a test makes; a key refreshes it, see ``refresh``."""
    return TopApp(FakeView(make), TopModel(), RouterClient(None), period_s=period_s)
