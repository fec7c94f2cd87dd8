"""``eapctl bus idn``: the IDNs of a drive, through its SoE mailbox."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from eap.cli.bus_params import (
    slave_argument,
)
from eap.cli.bus_place import BusCommand, Place, bus_options, open_session
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import CommandT, json_option

if TYPE_CHECKING:
    from eap.codec.soe import Idn

_MAX_DRIVE = 7


def parse_idn(text: str) -> Idn:
    """Read S-0-0032 or the 16 bits of an IDN; raise BadParameter with an example otherwise."""
    from eap.codec.soe import Idn

    try:
        if text[:1].isdecimal() and 0 <= int(text, 0) <= 0xFFFF:
            return Idn.of(int(text, 0))
        return Idn.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def _drive_option(command: CommandT) -> CommandT:
    return click.option(
        "--drive",
        type=click.IntRange(0, _MAX_DRIVE),
        default=0,
        show_default=True,
        metavar="N",
        help="Which drive of the slave.",
    )(command)


@click.group()
def idn() -> None:
    """Read, write and list the IDNs of a drive (SoE)."""


@idn.command(cls=BusCommand)
@bus_options
@slave_argument
@click.argument("number", type=parse_idn, metavar="IDN")
@_drive_option
@json_option("Print one object.")
def read(slave: str, number: Idn, drive: int, bus: Place, as_json: bool) -> None:
    """Read an IDN with all elements that it has."""
    from eap.appliance.commands.bus_idn import read_idn

    with open_session(bus) as session:
        row = read_idn(session, slave, number, drive=drive)
    if as_json:
        write_json(row)
        return
    from eap.cli.bus_view import idn_lines

    write_text("\n".join(idn_lines(row)))


@idn.command(cls=BusCommand, context_settings={"ignore_unknown_options": True})
@bus_options
@slave_argument
@click.argument("number", type=parse_idn, metavar="IDN")
@click.argument("value")
@_drive_option
@json_option("Print one object: what was written.")
def write(slave: str, number: Idn, value: str, drive: int, bus: Place, as_json: bool) -> None:
    """Write the value of an IDN.

    The numbers of a list have commas between them.
    """
    from eap.appliance.commands.bus_idn import write_idn

    with open_session(bus) as session:
        row = write_idn(session, slave, number, value, drive=drive)
    if as_json:
        write_json(row)
    else:
        write_text(f"{row['idn']} = {value}")


@idn.command("list", cls=BusCommand)
@bus_options
@slave_argument
@_drive_option
@json_option("Print one object a line.")
def list_idns(slave: str, drive: int, bus: Place, as_json: bool) -> None:
    """List all IDNs of a drive."""
    from eap.appliance.commands.bus_idn import list_idns as rows_of

    with open_session(bus) as session:
        if as_json:
            for row in rows_of(session, slave, drive=drive):
                write_json(row)
            return
        from eap.cli.bus_view import idn_table

        write_tables([idn_table(rows_of(session, slave, drive=drive))])
