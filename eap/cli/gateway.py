"""Mailbox gateways (ETG.8200): ``eapctl gateway`` at the station, ``gw`` as a client.

``gateway`` starts, stops and shows the gateways of a running station.  ``gw`` is a client of any
vendor's gateway and has the commands of ``eapctl bus``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import click

from eap.cli.completion import complete_target
from eap.cli.group import CommandGroup, LazyGroup
from eap.cli.output import Column, Renderer, TextTable, json_option
from eap.cli.params import (
    BusAddress,
    BusCommand,
    GatewayTarget,
    bus_options,
    bus_parameters,
    examples,
    open_session,
    plant_option,
)
from eap.errors import ControlError
from eap.quantities import count

if TYPE_CHECKING:
    from rich.tree import Tree

    from eap.control.bus import GatewayRow, MailboxFigures
    from eap.ops.bus_objects import SdoDumpEntry
    from eap.ops.client import ControlClient


_JSON = json_option("Print one object per gateway; docs/control.md explains its fields.")
_TARGET = click.argument("target", metavar="STATION[/PORT]", shell_complete=complete_target)
_SHOWN_CLIENTS = 10
"""Number of clients that are shown: each command is a client, so there may be hundreds."""
_PORT = 34980
_TCP, _MAILBOX = "--tcp", "--mailbox"
_FIRST_OF_COMMAND = 2
"""Words until the options of a command may come: HOST and its name."""


@click.group(
    cls=CommandGroup,
    epilog=examples(
        "eapctl gateway status island-01",
        "eapctl gateway stop island-01/bus0",
    ),
)
def gateway() -> None:
    """Start, stop and show the mailbox gateways of a station (ETG.8200).

    Each bus port has a gateway: other programs reach the slaves of the first bus at UDP and TCP
    port 34980, those of further buses at the following port numbers.  STATION means all bus ports
    of a station.
    """


@gateway.command()
@_TARGET
@plant_option
@_JSON
def start(target: str, plant: str | None, output: Renderer) -> None:
    """Start a gateway that was stopped."""
    output.show_rows(_call("start", target, plant), _state_lines)


@gateway.command(short_help="Stop a gateway; the bus keeps running.")
@_TARGET
@plant_option
@_JSON
def stop(target: str, plant: str | None, output: Renderer) -> None:
    """Stop a gateway until it is started again; the bus keeps running."""
    output.show_rows(_call("stop", target, plant), _state_lines)


@gateway.command(short_help="Show sockets, clients and requests.")
@click.argument("target", metavar="[STATION[/PORT]]", default="", shell_complete=complete_target)
@plant_option
@_JSON
def status(target: str, plant: str | None, output: Renderer) -> None:
    """Show sockets, clients and requests of a gateway.

    Without STATION, of all running stations.
    """
    rows, silent = (_call("status", target, plant), []) if target else _all_rows(plant)
    output.show_rows(rows, _status_view)
    if silent:
        raise silent[0]


def _call(
    action: Literal["start", "stop", "status"], target: str, plant: str | None
) -> list[GatewayRow]:
    from eap.control import bus as control_gateway
    from eap.ops.client import connect_station

    station, slash, port = target.partition("/")
    if not station or (slash and not port) or "/" in port:
        raise click.UsageError(f"{target!r} is neither STATION nor STATION/PORT")
    method = {
        "start": control_gateway.GATEWAY_START,
        "stop": control_gateway.GATEWAY_STOP,
        "status": control_gateway.GATEWAY_STATUS,
    }[action]
    with connect_station(station, plant) as client:
        return client.call(method, station=station, port=port)


def _all_rows(plant: str | None) -> tuple[list[GatewayRow], list[ControlError]]:
    """Return the gateways of all stations, and the errors of appliances that do not answer."""
    from contextlib import ExitStack

    from eap.control.bus import GATEWAY_STATUS
    from eap.control.protocol import ErrorCode
    from eap.ops.client import call_each, connect

    def rows_of(client: ControlClient) -> list[GatewayRow]:
        rows: list[GatewayRow] = []
        for station in client.info.stations:
            try:
                found: list[GatewayRow] = client.call(GATEWAY_STATUS, station=station)
            except ControlError as exc:
                if exc.code != ErrorCode.UNKNOWN_NAME:  # the station has no bus port
                    raise
            else:
                rows += found
        return rows

    with ExitStack() as stack:
        clients = [stack.enter_context(each) for each in connect(plant)]
        answers, silent = call_each(clients, rows_of)
    rows = [row for answer in answers for row in answer]
    if not rows and not silent:
        raise ControlError("no running station has a mailbox gateway: none has a bus port")
    return rows, silent


def _state_lines(rows: Iterable[GatewayRow]) -> Iterator[str]:
    for row in rows:
        yield f"{row.station}/{row.port}: {row.state}"


def _status_view(rows: Iterable[GatewayRow]) -> Iterator[TextTable | str]:
    for row in rows:
        yield from gateway_view(row)


def gateway_view(row: GatewayRow) -> Iterator[TextTable | str]:
    """Yield the state of one gateway, its clients, and the requests to master and slaves."""
    settings = row.settings
    served = ", ".join(row.served) or "no socket"
    silent = ", silent" if settings.silent else ""
    dropped = f", {count(row.dropped, 'frame')} dropped" if row.dropped else ""
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
            yield f"  {count(left, 'earlier client')} not shown (--json shows them)"
    if row.slaves:
        yield ""
        yield _table(
            (
                "Slave",
                "Protocol",
                Column("Requests", is_number=True),
                Column("Replies", rank=1, is_number=True),
                Column("Errors", is_number=True),
                Column("Mean reply", is_number=True),
                Column("Slowest reply", rank=2, is_number=True),
                Column("Last error", wraps=True),
            ),
            (
                (
                    _slave_text(each),
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


def _slave_text(row: MailboxFigures) -> str:
    from eap.gateway.requests import address_text

    name = f" ({row.name})" if row.name else ""
    return f"{address_text(row.address)}{name}" if row.address else "master"


def _table(columns: Iterable[Column | str], rows: Iterable[tuple[object, ...]]) -> TextTable:
    table = TextTable(*columns)
    for row in rows:
        table.add_row(*map(str, row))
    return table


def _time(value: float | None) -> str:
    return "" if not value else f"{value / 1000:.1f} ms"


def _parse_address(ctx: click.Context, param: click.Parameter, text: str) -> GatewayTarget:
    del ctx, param
    host, colon, digits = text.partition(":")
    if not colon:
        return GatewayTarget(host, _PORT)
    if not host or not digits.isdecimal() or not 0 < int(digits) <= 0xFFFF:
        raise click.BadParameter(f"{text!r} is not HOST[:PORT], such as 10.0.0.5 or plc:34981")
    return GatewayTarget(host, int(digits))


class GatewayGroup(LazyGroup):
    """Commands of ``eapctl bus`` through a mailbox gateway."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the group's own options anywhere: after HOST click would parse them as commands."""
        rest = iter(args)
        first: list[str] = []
        others: list[str] = []
        for word in rest:
            if word == "--":
                others.append(word)
                break
            is_help = word in ctx.help_option_names and len(others) < _FIRST_OF_COMMAND
            # Help of a subcommand comes behind its name, and is left to it.
            is_own = is_help or word.partition("=")[0] in {_TCP, _MAILBOX}
            (first if is_own else others).append(word)
            if word == _MAILBOX:
                first += [each for each in (next(rest, None),) if each is not None]
        return super().parse_args(ctx, [*first, *others, *rest])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one subcommand, and pass it the gateway as its bus."""
        command = super().get_command(ctx, cmd_name)
        return None if command is None else _behind_gateway(command)


def _behind_gateway(command: click.Command) -> click.Command:
    if isinstance(command, click.Group):
        found = {name: _behind_gateway(each) for name, each in command.commands.items()}
        return CommandGroup(command.name, found, help=command.help, epilog=None)
    left_out = bus_parameters()
    # The command keeps all its other parameters: only the choice of the bus differs.
    params = [each for each in command.params if each.name not in left_out]
    if len(params) == len(command.params):
        return command
    return click.Command(
        command.name,
        context_settings=command.context_settings,
        callback=partial(_invoke, command),
        params=params,
        help=command.help,
        short_help=command.short_help,
    )


def _invoke(command: click.Command, **values: Any) -> Any:
    context = click.get_current_context()
    place = context.find_object(GatewayTarget)
    return context.invoke(command.callback, bus=place, **values) if command.callback else None


@click.group(
    cls=GatewayGroup,
    commands_at={
        "foe": "eap.cli.bus:foe",
        "idn": "eap.cli.bus:idn",
        "od": "eap.cli.gateway:od",
        "scan": "eap.cli.bus:scan",
        "sdo": "eap.cli.bus:sdo",
        "voe": "eap.cli.bus:voe",
    },
    epilog=examples(
        "eapctl gw 127.0.1.1 scan",
        "eapctl gw 127.0.1.1 sdo read 1001 0x1018:1",
        "eapctl gw 127.0.1.1 od 0",
        "eapctl gw 127.0.1.1 foe put 1001 new.bin firmware.bin --tcp",
    ),
)
@click.option(_TCP, is_flag=True, help="Use TCP instead of UDP; anywhere on the command line.")
@click.option(
    _MAILBOX,
    type=click.IntRange(16, 1492),
    metavar="BYTES",
    help="Mailbox size of the slave where the master does not describe it (virtual addresses);"
    " files need it. Anywhere on the command line.",
)
@click.argument("place", metavar="HOST[:PORT]", callback=_parse_address)
@click.pass_context
def gw(ctx: click.Context, place: GatewayTarget, tcp: bool, mailbox: int | None) -> None:
    """Access a master and its slaves through a mailbox gateway of any vendor (ETG.8200).

    SLAVE is a station address (1001 is the first slave) or the slave's name as the master knows it;
    0 is the master itself.  PORT defaults to 34980.
    """
    ctx.obj = place._replace(tcp=tcp, mailbox=mailbox)


@click.command(cls=BusCommand, short_help="Show all objects of the master or a slave as a tree.")
@bus_options
@click.argument("slave", default="0", metavar="[SLAVE]")
@json_option("Print one object per line.")
def od(slave: str, bus: BusAddress, output: Renderer) -> None:
    """Show every object with its entries and values; SLAVE defaults to the master."""
    from eap.ops.bus_objects import dump_entries

    with open_session(bus) as session:
        entries = dump_entries(session, slave)
        output.show_rows(entries, lambda rows: _tree(session.find(slave).name, rows))


def _tree(name: str, rows: Iterable[SdoDumpEntry]) -> Iterator[Tree]:
    from rich.text import Text
    from rich.tree import Tree

    from eap.cli.bus_view import dumped_value

    tree = Tree(Text(name))
    branch, index = tree, -1
    for row in rows:
        if row.index != index:
            index = row.index
            branch = tree.add(Text(f"0x{index:04X} {row.object}"))
        branch.add(Text(f"{row.subindex:02X} {row.name}: ") + dumped_value(row).__rich__())
    yield tree
