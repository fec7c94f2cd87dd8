"""``eapctl log``: log levels of running appliances."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from eap.cli.output import Renderer, TextTable, json_option
from eap.cli.params import examples, plant_option

if TYPE_CHECKING:
    from eap.control.log import LogLevels
    from eap.ops.client import ControlClient

_LEVELS = ("debug", "info", "warning", "error")


@click.command(epilog=examples("eapctl log", "eapctl log debug routing", "eapctl log info"))
@click.argument("level", required=False, type=click.Choice(_LEVELS), metavar="[LEVEL]")
@click.argument("area", required=False, default="all", metavar="[AREA]")
@plant_option
@json_option("Print one object per appliance: levels by area.")
def log(level: str | None, area: str, plant: str | None, output: Renderer) -> None:
    """Show the log levels of running appliances, or set that of AREA, else of all areas.

    LEVEL is debug, info, warning or error.  The areas are those of the services process (ads,
    control, device, gateway, net, routing, slaves and transports) and the page, metrics and
    bridges that the plant file asks for.  A level holds until services restarts.
    """
    from eap.control.log import LOG_LEVELS, SET_LOG_LEVEL
    from eap.ops.client import call_each, connect

    def levels_of(client: ControlClient) -> LogLevels:
        if level is None:
            return client.call(LOG_LEVELS)
        return client.call(SET_LOG_LEVEL, level=level, area=area)

    with ExitStack() as stack:
        clients = [stack.enter_context(each) for each in connect(plant)]
        found, silent = call_each(clients, levels_of)
    output.show_rows(found, _table)
    if silent:
        raise silent[0]


def _table(rows: Iterable[LogLevels]) -> Iterator[TextTable]:
    for row in rows:
        table = TextTable("Area", "Level")
        for area, level in row.levels.items():
            table.add_row(area, level)
        yield table
