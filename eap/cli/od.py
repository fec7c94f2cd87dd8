"""``eapctl od``: the object dictionary of a station, or of a slave behind its bus."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.bus_params import parse_entry, parse_octets, parse_type
from eap.cli.od_params import target_argument
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import json_option

if TYPE_CHECKING:
    from eap.appliance.commands.od_target import Target
    from eap.codec.datatypes import DataType
    from eap.ids import ObjectId

_TYPE = click.option(
    "--type",
    "kind",
    type=parse_type,
    metavar="TYPE",
    help="Data type, such as UINT or STRING(16), in place of the one that the device tells.",
)


@click.group()
def od() -> None:
    """Read and write the object dictionary of a station.

    TARGET is STATION or STATION/PORT for an EAP port of a station, STATION/router for its router,
    STATION/PORT for the master of a bus port, and STATION/PORT/SLAVE for a slave behind it.  What
    does not run here, by name or as NETID:PORT, is asked through routes.  INDEX and SUB are
    hexadecimal, with or without 0x (0xD000:07, D000:7).
    """


@od.command("list")
@target_argument
@json_option("Print one object a line.")
def list_objects(target: Target, as_json: bool) -> None:
    """List all objects with their names."""
    from eap.appliance.commands.od_access import object_rows
    from eap.appliance.commands.od_target import open_device

    with open_device(target) as device:
        rows = list(object_rows(device.objects()))
    if as_json:
        for row in rows:
            write_json(row)
        return
    from eap.cli.bus_view import object_table
    from eap.cli.od_view import object_name

    named = (row | {"name": object_name(row["name"], row["label"])} for row in rows)
    write_tables([object_table(named)])


@od.command()
@target_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@_TYPE
@click.option(
    "--complete", is_flag=True, help="The whole object at once, from INDEX:0 or INDEX:1 on."
)
@json_option("Print one object.")
def read(
    entry: ObjectId, kind: DataType | None, complete: bool, target: Target, as_json: bool
) -> None:
    """Read an entry, or a whole object."""
    from eap.appliance.commands.od_access import read_entry, read_object
    from eap.appliance.commands.od_target import open_device

    with open_device(target) as device:
        row = read_object(device, *entry) if complete else read_entry(device, *entry, kind)
    if as_json:
        write_json(row)
        return
    from eap.cli.od_view import object_lines, value_line

    write_text("\n".join(object_lines(row)) if complete else value_line(row))


@od.command(context_settings={"ignore_unknown_options": True})
@target_argument
@click.argument("entry", required=False, metavar="[INDEX[:SUB]]")
@click.argument("value", required=False, metavar="[VALUE]")
@_TYPE
@click.option(
    "--hex", "octets", type=parse_octets, metavar="DIGITS", help="Octets as they are, for VALUE."
)
@click.option(
    "--complete",
    is_flag=True,
    help="The whole object at once, from INDEX:0 or INDEX:1 on; needs --hex.",
)
@click.option(
    "--from",
    "file",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    metavar="FILE",
    help="Everything that 'od dump' wrote to FILE, in the order that a device needs.",
)
@json_option("Print one object: what was written.")
def write(
    entry: str | None,
    value: str | None,
    kind: DataType | None,
    octets: bytes | None,
    complete: bool,
    file: Path | None,
    target: Target,
    as_json: bool,
) -> None:
    """Write an entry, a whole object, or all that a file holds.

    VALUE is as the entry's type has it: 12, 0xC, -1.5e3, true, text, hexadecimal digits for octets,
    and 127.0.1.1.2.1, 01:01:05:04:00:00 or 10.0.0.1 where these are an address.

    A station takes configuration in PREOP only ('eapctl state TARGET PREOP').
    """
    if file is not None:
        if entry or value or octets is not None or kind is not None or complete:
            raise click.UsageError("--from FILE says what to write: leave the rest out")
        from eap.cli.od_load import load

        load(target, file, as_json=as_json)
        return
    place = _entry_to_write(entry, value, octets, complete=complete)
    from eap.appliance.commands.od_access import write_entry, write_octets
    from eap.appliance.commands.od_target import open_device

    with open_device(target) as device:
        if octets is not None:
            row = write_octets(device, *place, octets, complete=complete)
        else:
            row = write_entry(device, *place, value or "", kind)
    if as_json:
        write_json(row)
        return
    from eap.cli.od_view import value_line

    write_text(value_line(row))


@od.command()
@target_argument
@json_option("Print one entry a line, as an object.")
def dump(target: Target, as_json: bool) -> None:
    """Write all entries of all objects to stdout, for people and for 'od write --from'."""
    from eap.appliance.commands.od_access import dump_rows
    from eap.appliance.commands.od_target import open_device

    with open_device(target) as device:
        rows = dump_rows(device.contents())
        if as_json:
            for row in rows:
                write_json(row)
            return
        from eap.cli.od_file import dump_lines

        for line in dump_lines(str(target), rows):
            write_text(line)


def _entry_to_write(
    entry: str | None, value: str | None, octets: bytes | None, *, complete: bool
) -> ObjectId:
    """Return index and subindex; raise UsageError unless exactly one value is given."""
    if entry is None:
        raise click.UsageError("say what to write: INDEX[:SUB] VALUE, or --from FILE")
    if (value is None) == (octets is None):
        raise click.UsageError("say the value once: VALUE, or --hex DIGITS")
    if complete and octets is None:
        raise click.UsageError("--complete writes octets: give them with --hex DIGITS")
    return parse_entry(entry)
