"""``eapctl gateway``: the ETG.8200 gateways of a station, which bring mailboxes to its slaves."""

from __future__ import annotations

from typing import Any

import click

from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import examples, json_option, plant_option

_JSON = json_option("Print one object for each gateway; docs/control.md explains its fields.")
_TARGET = click.argument("target", metavar="STATION[/PORT]")


@click.group(
    short_help="Start, stop and show the ETG.8200 gateways of a station.",
    epilog=examples(
        "eapctl gateway status island-01",
        "eapctl gateway stop island-01/bus0",
    ),
)
def gateway() -> None:
    """Start, stop and show the mailbox gateways of a station (ETG.8200).

    Each bus port has one: other programs reach its slaves by UDP and TCP 34980, those of further
    bus ports by the numbers behind it.  STATION stands for all bus ports of a station.
    """


@gateway.command()
@_TARGET
@plant_option
@_JSON
def start(target: str, plant: str | None, as_json: bool) -> None:
    """Let a gateway answer, again."""
    _tell(_ask("gateway_start", target, plant), as_json=as_json)


@gateway.command(short_help="Let a gateway answer nothing more; the bus runs on.")
@_TARGET
@plant_option
@_JSON
def stop(target: str, plant: str | None, as_json: bool) -> None:
    """Let a gateway answer nothing more until it is started; the bus runs on."""
    _tell(_ask("gateway_stop", target, plant), as_json=as_json)


@gateway.command(short_help="Show sockets, clients, and what was asked of whom.")
@click.argument("target", metavar="[STATION[/PORT]]", default="")
@plant_option
@_JSON
def status(target: str, plant: str | None, as_json: bool) -> None:
    """Show where a gateway is served, its clients, and what was asked of whom.

    Without STATION, of all gateways that run.
    """
    rows = _ask("gateway_status", target, plant) if target else _all_rows(plant)
    if as_json:
        _tell(rows, as_json=True)
        return
    from eap.cli.gateway_view import gateway_tables  # rich; --help must not wait for it

    for row in rows:
        write_tables(gateway_tables(row))


def _ask(method: str, target: str, plant: str | None) -> list[dict[str, Any]]:
    from eap.appliance.commands.client import connect_station

    station, slash, port = target.partition("/")
    if not station or (slash and not port) or "/" in port:
        raise click.UsageError(f"{target!r} is no STATION and no STATION/PORT")
    with connect_station(station, plant) as client:
        rows: list[dict[str, Any]] = client.request(method, station=station, port=port)
    return rows


def _all_rows(plant: str | None) -> list[dict[str, Any]]:
    """Return the gateways of all stations of the running appliances."""
    from contextlib import ExitStack

    from eap.appliance.commands.client import connect
    from eap.appliance.control import ErrorCode
    from eap.errors import ControlError

    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant)]:
            for station in client.info.stations:
                try:
                    rows += client.request("gateway_status", station=station)
                except ControlError as exc:
                    if exc.code != ErrorCode.UNKNOWN_NAME:  # else it has no bus port
                        raise
    if not rows:
        raise ControlError("no running station has a mailbox gateway")
    return rows


def _tell(rows: list[dict[str, Any]], *, as_json: bool) -> None:
    for row in rows:
        if as_json:
            write_json(row)
        else:
            write_text(f"{row['station']}/{row['port']}: {row['state']}")
