"""``eapctl status``: how the running stations are doing."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import click

from eap.cli.output import write_json, write_tables
from eap.cli.params import json_option, plant_option, station_option


@click.command(short_help="Show processes, stations, ports and process data.")
@plant_option
@station_option
@json_option("Print one object; docs/control.md explains its fields.")
def status(plant: str | None, station: str | None, as_json: bool) -> None:
    """Show the processes, stations, ports and process data of all running appliances."""
    document = _ask(plant, station)
    if as_json:
        write_json(document)
        return
    from eap.cli.status_view import status_tables  # rich; --help must not wait for it

    write_tables(status_tables(document))


def _ask(plant: str | None, station: str | None) -> dict[str, Any]:
    """Return the merged answer of the chosen appliances, cut down to *station* if it is given."""
    from eap.appliance.commands.client import connect, merge_status

    with ExitStack() as stack:
        clients = [stack.enter_context(client) for client in connect(plant, station)]
        document = merge_status([client.request("status") for client in clients])
    if station:
        document["stations"] = [row for row in document["stations"] if row["name"] == station]
    return document
