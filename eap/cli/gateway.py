"""``eapctl gateway``: the mailbox gateways of a station (ETG.8200)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Literal

import click

from eap.cli.output import Renderer
from eap.cli.params import examples, json_option, plant_option

if TYPE_CHECKING:
    from eap.cli.table import Column, TextTable
    from eap.control.gateway import GatewayRow

_JSON = json_option("Print one object for each gateway; docs/control.md explains its fields.")
_TARGET = click.argument("target", metavar="STATION[/PORT]")
_SHOWN_CLIENTS = 10
"""Each command is a client of its own, so there are soon hundreds."""


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
def start(target: str, plant: str | None, output: Renderer) -> None:
    """Start a gateway that was stopped."""
    output.show_rows(_call("start", target, plant), _state_lines)


@gateway.command(short_help="Stop a gateway; the bus goes on.")
@_TARGET
@plant_option
@_JSON
def stop(target: str, plant: str | None, output: Renderer) -> None:
    """Stop a gateway until it is started again; the bus goes on."""
    output.show_rows(_call("stop", target, plant), _state_lines)


@gateway.command(short_help="Show sockets, clients and requests.")
@click.argument("target", metavar="[STATION[/PORT]]", default="")
@plant_option
@_JSON
def status(target: str, plant: str | None, output: Renderer) -> None:
    """Show sockets, clients and requests of a gateway.

    Without STATION, of all gateways that run.
    """
    rows = _call("status", target, plant) if target else _all_rows(plant)
    output.show_rows(rows, _status_view)


def _call(
    action: Literal["start", "stop", "status"], target: str, plant: str | None
) -> list[GatewayRow]:
    from eap.control import gateway as control_gateway
    from eap.ops.client import connect_station

    station, slash, port = target.partition("/")
    if not station or (slash and not port) or "/" in port:
        raise click.UsageError(f"{target!r} is no STATION and no STATION/PORT")
    method = {
        "start": control_gateway.GATEWAY_START,
        "stop": control_gateway.GATEWAY_STOP,
        "status": control_gateway.GATEWAY_STATUS,
    }[action]
    with connect_station(station, plant) as client:
        return client.call(method, station=station, port=port)


def _all_rows(plant: str | None) -> list[GatewayRow]:
    """Return the gateways of all stations of the running appliances."""
    from contextlib import ExitStack

    from eap.control.gateway import GATEWAY_STATUS
    from eap.control.protocol import ErrorCode
    from eap.errors import ControlError
    from eap.ops.client import connect

    rows: list[GatewayRow] = []
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant)]:
            for station in client.info.stations:
                try:
                    found = client.call(GATEWAY_STATUS, station=station)
                except ControlError as exc:
                    if exc.code != ErrorCode.UNKNOWN_NAME:  # else it has no bus port
                        raise
                else:
                    rows += found
    if not rows:
        raise ControlError("no running station has a mailbox gateway")
    return rows


def _state_lines(rows: Iterable[GatewayRow]) -> Iterator[str]:
    for row in rows:
        yield f"{row.station}/{row.port}: {row.state}"


def _status_view(rows: Iterable[GatewayRow]) -> Iterator[TextTable | str]:
    for row in rows:
        yield from gateway_view(row)


def gateway_view(row: GatewayRow) -> Iterator[TextTable | str]:
    """Yield the state of one gateway, its clients, and the requests to master and slaves."""
    from eap.cli.table import Column, count

    settings = row.settings
    served = ", ".join(row.served) or "nowhere"
    silent = ", silent" if settings.silent else ""
    dropped = f", {count(row.turned_away, 'frame')} dropped" if row.turned_away else ""
    yield (
        f"{row.station}/{row.port}: {row.state} at {served};"
        f" answers within {settings.answer_ms} ms{silent}{dropped}"
    )
    if row.clients:
        yield ""
        latest = row.clients[::-1]
        shown = [each for at, each in enumerate(latest) if at < _SHOWN_CLIENTS or each.transfers]
        yield _table(
            (
                "Client",
                Column("Transport", rank=2),
                Column("Requests", is_number=True),
                Column("Repeated", rank=1, is_number=True),
                Column("Errors", is_number=True),
                Column("Transfers", wraps=True),
            ),
            (
                (
                    each.address,
                    each.transport,
                    each.requests,
                    each.repeated,
                    each.errors,
                    ", ".join(f"{one.protocol} {one.address}" for one in each.transfers),
                )
                for each in shown
            ),
        )
        if left := len(latest) - len(shown):
            yield f"  {count(left, 'earlier client')} not shown; --json shows all"
    if row.slaves:
        yield ""
        yield _table(
            (
                "Slave",
                "Protocol",
                Column("Requests", is_number=True),
                Column("Replies", rank=1, is_number=True),
                Column("Errors", is_number=True),
                Column("Mean", is_number=True),
                Column("Slowest", rank=2, is_number=True),
                Column("Last error", wraps=True),
            ),
            (
                (
                    each.address or "master",
                    each.protocol,
                    each.requests,
                    each.replies,
                    sum(each.errors.values()),
                    _time(each.mean_us),
                    _time(each.slowest_us),
                    each.last_error,
                )
                for each in row.slaves
            ),
        )


def _table(columns: Iterable[Column | str], rows: Iterable[tuple[object, ...]]) -> TextTable:
    from eap.cli.table import TextTable

    table = TextTable(*columns)
    for row in rows:
        table.add_row(*map(str, row))
    return table


def _time(value: float | None) -> str:
    return "" if not value else f"{value / 1000:.1f} ms"
