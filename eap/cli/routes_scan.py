"""``eapctl routes scan``: which AMS routers other hosts have."""

from __future__ import annotations

import click

from eap.cli.output import write_json, write_tables
from eap.cli.params import ANSWER_MARGIN_S, examples, json_option, plant_option


@click.command(
    short_help="Ask which routers other hosts have, and learn routes to them.",
    epilog=examples("eapctl routes scan", "eapctl routes scan island-01 --address 192.168.1.5"),
)
@click.argument("station", required=False, metavar="[STATION]")
@click.option(
    "--address",
    default="",
    metavar="ADDRESS",
    help="Ask this host or network only, by its IPv4 address; the networks of STATION without.",
)
@click.option(
    "--wait",
    "wait_ms",
    type=click.IntRange(10, 60_000),
    default=1000,
    show_default=True,
    metavar="MS",
    help="Patience for answers.",
)
@plant_option
@json_option("Print one object a router and line.")
def scan(station: str | None, address: str, wait_ms: int, plant: str | None, as_json: bool) -> None:
    """Ask by UDP 48899 which AMS routers other hosts have.

    Routes to those that answer are learned, for ten minutes, unless there is one already or the
    plant file says 'learn: false'.  Asks from STATION, or from all that run here.
    """
    from eap.appliance.commands.client import connect
    from eap.appliance.control_routes import NeighbourRow, read_document

    clients = connect(plant, station)
    found: list[NeighbourRow] = []
    try:
        for client in clients:
            answer = client.request_within(
                wait_ms / 1000 + ANSWER_MARGIN_S,
                "routes_scan",
                station=station or "",
                address=address,
                wait_ms=wait_ms,
            )
            found += read_document(answer, list[NeighbourRow])
    finally:
        for client in clients:
            client.close()
    if as_json:
        for row in found:
            write_json(row)
        return
    from eap.cli.routes_view import neighbour_table

    write_tables([neighbour_table(found)])
