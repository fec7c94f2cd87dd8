"""``eapctl bus sdo``: the objects of a slave, through its CoE mailbox."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from eap.cli.bus_params import parse_entry, parse_type, slave_argument
from eap.cli.bus_place import BusCommand, Place, bus_options, open_session
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import CommandT, json_option

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType
    from eap.ids import ObjectId


def _value_options(command: CommandT) -> CommandT:
    complete = click.option(
        "--complete", is_flag=True, help="The whole object at once, from INDEX:0 or INDEX:1 on."
    )
    kind = click.option(
        "--type",
        "kind",
        type=parse_type,
        metavar="TYPE",
        help="Data type, such as UINT or STRING(16); asked of the slave if left out.",
    )
    return complete(kind(command))


@click.group()
def sdo() -> None:
    """Read, write and list the objects of a slave (CoE)."""


@sdo.command(cls=BusCommand)
@bus_options
@slave_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@_value_options
@json_option("Print one object.")
def read(
    slave: str,
    entry: ObjectId,
    kind: DataType | None,
    complete: bool,
    bus: Place,
    as_json: bool,
) -> None:
    """Read an entry.

    INDEX and SUB are hexadecimal, with or without 0x: 0x1018:01, 1018:1.
    """
    from eap.appliance.commands.bus_sdo import read_entry

    with open_session(bus) as session:
        row = read_entry(session, slave, *entry, kind=kind, complete=complete)
    if as_json:
        write_json(row)
        return
    from eap.cli.bus_view import value_line

    write_text(value_line(row))


@sdo.command(cls=BusCommand, context_settings={"ignore_unknown_options": True})
@bus_options
@slave_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@click.argument("value")
@_value_options
@json_option("Print one object: what was written.")
def write(
    slave: str,
    entry: ObjectId,
    value: str,
    kind: DataType | None,
    complete: bool,
    bus: Place,
    as_json: bool,
) -> None:
    """Write an entry.

    INDEX and SUB are hexadecimal, with or without 0x: 0x8000:01, 8000:1.  VALUE is as the type has
    it: 12, 0xC, -1.5e3, true, text; hexadecimal digits for a block and with --complete.
    """
    from eap.appliance.commands.bus_sdo import write_entry

    with open_session(bus) as session:
        row = write_entry(session, slave, *entry, value, kind=kind, complete=complete)
    if as_json:
        write_json(row)
        return
    from eap.cli.bus_view import entry_name

    write_text(f"{entry_name(row)} = {value}")


@sdo.command("list", cls=BusCommand)
@bus_options
@slave_argument
@json_option("Print one object a line.")
def list_objects(slave: str, bus: Place, as_json: bool) -> None:
    """List the objects that the slave describes."""
    from eap.appliance.commands.bus_sdo import list_objects as rows_of

    with open_session(bus) as session:
        if as_json:
            for row in rows_of(session, slave):
                write_json(row)
            return
        from eap.cli.bus_view import object_table

        write_tables([object_table(rows_of(session, slave))])


@sdo.command(cls=BusCommand)
@bus_options
@slave_argument
@json_option("Print one object a line.")
def dump(slave: str, bus: Place, as_json: bool) -> None:
    """Read every entry of every object that the slave describes."""
    from eap.appliance.commands.bus_sdo import dump_entries

    with open_session(bus) as session:
        if as_json:
            for row in dump_entries(session, slave):
                write_json(row)
            return
        from eap.cli.bus_view import dump_table

        write_tables([dump_table(dump_entries(session, slave))])
