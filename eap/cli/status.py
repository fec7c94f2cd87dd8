"""``eapctl status``: the state of the running appliances, once or again and again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from threading import Event
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from eap.cli.output import Renderer, repaint, write_json
from eap.cli.params import json_option, plant_option, station_option
from eap.errors import ControlError

if TYPE_CHECKING:
    from rich.console import RenderableType

_LEAST_INTERVAL_S = 0.1


class Look(NamedTuple):
    """One answer of the appliances.

    Attributes:
        now_s: Unix time of the look.
        document: The merged answer, with its findings.
        earlier: The document of the look before, where there is one.
        seconds: How long ago that was.
    """

    now_s: float
    document: dict[str, Any]
    earlier: dict[str, Any] | None = None
    seconds: float = 0.0


@click.command(short_help="Show errors, stations, ports, process data and processes.")
@click.option("--full", is_flag=True, help="Show every process, port, bus and PD.")
@click.option("--watch", is_flag=True, help="Show it again and again, with rates; Ctrl-C ends it.")
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(_LEAST_INTERVAL_S),
    default=2.0,
    show_default=True,
    metavar="S",
    help="Seconds from one look to the next with --watch.",
)
@plant_option
@station_option
@json_option("Print one object; docs/control.md explains its fields.")
def status(
    full: bool,
    watch: bool,
    interval_s: float,
    plant: str | None,
    station: str | None,
    output: Renderer,
) -> None:
    """Show the state of the running appliances: errors first, then a line for each station.

    Errors and warnings have place, cause, beginning and remedy.
    """
    view = _full if full else _screen
    if not watch:
        look = _look(plant, station)
        output.show(look.document, lambda _: view(look))
        return
    try:
        for found in _looks(plant, station, interval_s):
            if output.is_json:
                _write_object(found)
            else:
                repaint(_page(found, view, interval_s))
    except KeyboardInterrupt:
        return


def _looks(plant: str | None, station: str | None, interval_s: float) -> Iterator[Look | str]:
    """Yield a look every *interval_s*, or why there was no answer; never end."""
    before: tuple[float, Look] | None = None
    while True:
        start = time.monotonic()
        try:
            look = _look(plant, station)
        except ControlError as exc:
            before = None
            yield str(exc)
        else:
            if before is not None:
                at, last = before
                look = look._replace(earlier=last.document, seconds=start - at)
            before = (start, look)
            yield look
        _pause(max(0.0, start + interval_s - time.monotonic()))


def _pause(seconds: float) -> None:
    Event().wait(seconds)


def _look(plant: str | None, station: str | None) -> Look:
    """Return the merged answer of the chosen appliances, cut down to *station* if it is given."""
    from eap.cli.status_findings import findings
    from eap.ops.client import connect, merge_status

    with ExitStack() as stack:
        clients = [stack.enter_context(client) for client in connect(plant, station)]
        document = merge_status([client.request("status") for client in clients])
    if station:
        document["stations"] = [row for row in document["stations"] if row["name"] == station]
    now_s = time.time()
    document["findings"] = [each.to_plain() for each in findings(document, now_s)]
    return Look(now_s, document)


def _write_object(found: Look | str) -> None:
    if isinstance(found, Look):
        write_json(found.document)
    else:
        click.echo(found, err=True)


def _page(
    found: Look | str, view: Callable[[Look], Iterable[RenderableType]], interval_s: float
) -> Iterator[RenderableType]:
    from eap.cli.table import Styled

    yield Styled(f"{time.strftime('%H:%M:%S')}, every {interval_s:g} s", style="dim")
    if isinstance(found, Look):
        yield from view(found)
    else:
        yield Styled(f"{found}; waiting for it", style="bold red")


def _screen(look: Look) -> Iterator[RenderableType]:
    from eap.cli.status_view import StatusScreen

    yield StatusScreen(look.document, look.now_s, look.earlier, look.seconds)


def _full(look: Look) -> Iterator[RenderableType]:
    from eap.cli.status_view import full_view

    return full_view(look.document, look.now_s)
