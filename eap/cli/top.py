"""``eapctl top``: live overview of running plants, on a screen or as lines for scripts.

On a terminal it is an application of textual (``top_tui``), an extra.  Without it, on a terminal
that cannot move its cursor, and in a pipe the same rows are printed as text.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import click

from eap.cli.output import (
    Column,
    Renderer,
    Styled,
    TextTable,
    json_option,
    repaint,
    write_json,
    write_view,
)
from eap.cli.params import examples, plant_option
from eap.errors import ControlError, EnvironmentalError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from eap.cli.top_model import TopModel
    from eap.live.client import LiveClient
    from eap.live.view import LiveReport, LiveView

_LEAST_INTERVAL_S = 0.1
_FIRST_ANSWER_S = 6.0
"""Time for the first report of what is printed: longer than that for an answer."""
_SORT_KEYS = (
    "name",
    "state",
    "tx_per_s",
    "rx_per_s",
    "lost",
    "late",
    "age_us",
    "jitter_p99_us",
    "bus",
)


def _to_remote(
    ctx: click.Context, param: click.Parameter, texts: tuple[str, ...]
) -> tuple[str, ...]:
    """Check the hosts of ``--connect``; raise BadParameter for another form."""
    del ctx, param
    if texts:
        from eap.live.ads_connection import RemoteHost

        for text in texts:
            try:
                RemoteHost.parse(text)
            except ValueError as exc:
                raise click.BadParameter(str(exc)) from None
    return texts


@click.command(
    epilog=examples(
        "eapctl top",
        "eapctl top --connect 10.0.0.5 --connect 10.0.0.6",
        "eapctl top --once --json --filter 'lost>0'",
        "eapctl top --count 60 --json > minute.jsonl",
    )
)
@click.option(
    "--connect",
    "hosts",
    multiple=True,
    callback=_to_remote,
    metavar="HOST[:NETID]",
    help="The appliance of another host, by ADS; several are shown together.",
)
@click.option("--once", is_flag=True, help="Print the rows once and end.")
@click.option(
    "--count", type=click.IntRange(1), metavar="N", help="Print the rows N times and end."
)
@click.option(
    "--sort",
    "sort_key",
    type=click.Choice(_SORT_KEYS),
    metavar="KEY",
    help=f"Sort by KEY: {', '.join(_SORT_KEYS)}.",
)
@click.option(
    "--filter",
    "match",
    default="",
    metavar="EXPR",
    help="Only rows that fit: a name, or KEY>NUMBER such as 'lost>0', 'age>5ms', 'state!=OP'.",
)
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(_LEAST_INTERVAL_S),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Seconds between refreshes.",
)
@click.option(
    "--write",
    "may_write",
    is_flag=True,
    help="Allow changes of routes in their view, and recordings.",
)
@plant_option
@json_option("Print one object for each station; docs/top.md explains its fields.")
def top(
    hosts: tuple[str, ...],
    once: bool,
    count: int | None,
    sort_key: str | None,
    match: str,
    interval_s: float,
    may_write: bool,
    plant: str | None,
    output: Renderer,
) -> None:
    """Watch running plants: stations, process data, buses, routes, and what happens, in words.

    In a terminal the view is live, with keyboard and mouse; '?' explains the keys. Otherwise, and
    with --once, --count or --json, the rows are printed.
    """
    from eap.cli.top_model import Tab, TopModel

    model = TopModel(match=match, sort_key=sort_key or "")
    try:
        model.filter_of(Tab.STATIONS)
    except ValueError as exc:
        raise click.UsageError(f"--filter: {exc}") from None
    is_printed = once or count is not None or output.is_json
    if not is_printed and _is_screen():
        try:
            run_app(
                plant or "",
                hosts,
                model,
                interval_s=interval_s,
                may_write=may_write,
                instead="this plain view",
            )
        except _NoTextualError as exc:
            click.echo(exc, err=True)
        else:
            return
    number = 1 if once else count
    with suppress(KeyboardInterrupt):
        asyncio.run(_print_rows(live_view(plant or "", hosts), model, output, number, interval_s))


def run_app(
    plant: str,
    hosts: tuple[str, ...] = (),
    model: TopModel | None = None,
    *,
    tab: str = "stations",
    interval_s: float = 1.0,
    may_write: bool = False,
    instead: str,
) -> None:
    """Run the application until it is left.

    Args:
        plant: Only the appliances that run it; all if empty.
        hosts: Of other appliances; those of this host without one.
        model: What is chosen; all without it.
        tab: View to begin with.
        interval_s: Seconds between refreshes.
        may_write: Whether routes may be changed, and recordings be made.
        instead: Command without textual, for the message.

    Raises:
        EnvironmentalError: textual is not installed.
    """
    try:
        from eap.cli.routes_tui.table import RemoteRouters, RouterClient, RouteRequests
        from eap.cli.top_tui.app import READ_ONLY, TopApp
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] != "textual":
            raise
        raise _NoTextualError(
            "the live view needs Textual: install it with pip install 'eap-appliance[tui]', or use"
            f" {instead}"
        ) from None
    from eap.cli.top_model import Tab, TopModel

    view = live_view(plant, hosts)
    routes: RouteRequests = RemoteRouters(hosts) if hosts else RouterClient(plant or None)
    refusal = record_refusal = "" if may_write else READ_ONLY
    if hosts:
        refusal = "Routes of other hosts are changed there."
        record_refusal = "Recordings are made on the host of the plant: eapctl record start"
    app = TopApp(
        view,
        model or TopModel(),
        routes,
        tab=Tab(tab),
        period_s=interval_s,
        refusal=refusal,
        record_refusal=record_refusal,
    )
    app.run()


def live_view(plant: str, hosts: tuple[str, ...]) -> LiveView:
    """Return the view of the appliances of this host, or of *hosts*."""
    from eap.live.view import LiveView

    return LiveView(plant, dict(map(_remote, hosts)))


def _remote(text: str) -> tuple[str, LiveClient]:
    from eap.live.ads_connection import AdsConnection, RemoteHost
    from eap.live.client import LiveClient

    return text, LiveClient(partial(AdsConnection.open, RemoteHost.parse(text)))


class _NoTextualError(EnvironmentalError):
    """The extra that draws on a screen is not installed."""


def _is_screen() -> bool:
    """Return whether stdout is a terminal whose cursor can be moved, with a keyboard."""
    is_terminal = sys.stdin.isatty() and sys.stdout.isatty()
    return is_terminal and os.environ.get("TERM", "dumb") != "dumb"


async def _print_rows(
    view: LiveView, model: TopModel, output: Renderer, number: int | None, interval_s: float
) -> None:
    """Print the rows *number* times, without one for ever.

    Raises:
        ControlError: nothing answers, with a *number*.
    """
    clock = asyncio.get_running_loop().time
    is_repainted = not output.is_json and number is None and _is_screen()
    printed = 0
    async with view:
        model.take(await view.take(within_s=_FIRST_ANSWER_S))
        due_s = clock()
        while number is None or printed < number:
            # Rates need two reports.
            due_s = max(due_s + interval_s, clock())
            await asyncio.sleep(due_s - clock())
            report = await view.take()
            model.take(report)
            if number is not None and not report.status.stations:
                raise ControlError(model.head())
            printed += 1
            if output.is_json:
                for row in model.stations():
                    write_json(row)
                continue
            parts = list(_page(model, report))
            if is_repainted:
                repaint(parts)
            else:
                write_view(parts)
    if report.unreachable:
        raise ControlError("; ".join(f"{name}: {why}" for name, why in report.unreachable.items()))


def _page(model: TopModel, report: LiveReport) -> Iterator[RenderableType]:
    from eap.cli.top_model import COLUMNS, Tab, clock, event_text

    yield Styled(f"{clock(report.time)} {model.head()}", style="bold")
    columns = COLUMNS[Tab.STATIONS]
    table = TextTable(
        *(Column(each.heading, rank=each.rank, is_number=each.is_number) for each in columns)
    )
    for line in model.lines(Tab.STATIONS):
        table.add_row(*map(Styled, line.cells, line.styles))
    yield table
    yield from (Styled(event_text(each)) for each in report.events)
