"""``eapctl gw``: slaves behind any mailbox gateway (ETG.8200), with the commands of ``bus``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from eap.cli.bus_place import (
    BusCommand,
    GatewayPlace,
    Place,
    bus_options,
    open_session,
    place_parameters,
)
from eap.cli.group import LazyGroup
from eap.cli.output import Renderer
from eap.cli.params import examples, json_option

if TYPE_CHECKING:
    from rich.tree import Tree

    from eap.ops.bus_objects import SdoDumpEntry

_PORT = 34980
_TCP, _MAILBOX = "--tcp", "--mailbox"
_FIRST_OF_COMMAND = 2
"""Words until the options of a command may come: HOST and its name."""


def _parse_place(ctx: click.Context, param: click.Parameter, text: str) -> GatewayPlace:
    del ctx, param
    host, colon, digits = text.partition(":")
    if not colon:
        return GatewayPlace(host, _PORT)
    if not host or not digits.isdecimal() or not 0 < int(digits) <= 0xFFFF:
        raise click.BadParameter(f"{text!r} is not HOST[:PORT], such as 10.0.0.5 or plc:34981")
    return GatewayPlace(host, int(digits))


class GatewayGroup(LazyGroup):
    """Commands of ``eapctl bus``, whose bus is the gateway."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take own options wherever they stand: behind HOST they would be taken for commands."""
        rest = iter(args)
        first: list[str] = []
        others: list[str] = []
        for word in rest:
            if word == "--":
                others.append(word)
                break
            is_help = word in ctx.help_option_names and len(others) < _FIRST_OF_COMMAND
            is_own = is_help or word.partition("=")[0] in {_TCP, _MAILBOX}
            (first if is_own else others).append(word)
            if word == _MAILBOX:
                first += [each for each in (next(rest, None),) if each is not None]
        return super().parse_args(ctx, [*first, *others, *rest])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one subcommand, and give it the gateway in the place of a bus."""
        command = super().get_command(ctx, cmd_name)
        return None if command is None else _behind_gateway(command)


def _behind_gateway(command: click.Command) -> click.Command:
    if isinstance(command, click.Group):
        found = {name: _behind_gateway(each) for name, each in command.commands.items()}
        return click.Group(command.name, found, help=command.help, epilog=None)
    left_out = place_parameters()
    params = [each for each in command.params if each.name not in left_out]
    if len(params) == len(command.params):
        return command
    return click.Command(
        command.name,
        context_settings=command.context_settings,
        callback=partial(_call, command),
        params=params,
        help=command.help,
        short_help=command.short_help,
    )


def _call(command: click.Command, **values: Any) -> Any:
    context = click.get_current_context()
    place = context.find_object(GatewayPlace)
    return context.invoke(command.callback, bus=place, **values) if command.callback else None


@click.group(
    cls=GatewayGroup,
    commands_at={
        "foe": "eap.cli.bus:foe",
        "idn": "eap.cli.bus:idn",
        "od": "eap.cli.gw:od",
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
@click.option(
    _TCP, is_flag=True, help="Connect by TCP, else datagrams are sent (UDP); anywhere on the line."
)
@click.option(
    _MAILBOX,
    type=click.IntRange(16, 1492),
    metavar="OCTETS",
    help="How large the slave's mailbox is where the master does not tell, as of virtual addresses;"
    " files need it. Anywhere on the line.",
)
@click.argument("place", metavar="HOST[:PORT]", callback=_parse_place)
@click.pass_context
def gw(ctx: click.Context, place: GatewayPlace, tcp: bool, mailbox: int | None) -> None:
    """Talk to a master and its slaves through a mailbox gateway, any vendor's.

    SLAVE is a station address (1001 is the first slave) or the slave's name as the master knows it;
    0 is the master itself.  The port is 34980 if it is left out.
    """
    ctx.obj = place._replace(tcp=tcp, mailbox=mailbox)


@click.command(cls=BusCommand, short_help="Show all objects of the master or a slave as a tree.")
@bus_options
@click.argument("slave", default="0", metavar="[SLAVE]")
@json_option("Print one object a line.")
def od(slave: str, bus: Place, output: Renderer) -> None:
    """Show every object with its entries and values; of the master if SLAVE is left out."""
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
