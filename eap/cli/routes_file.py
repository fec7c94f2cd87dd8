"""``eapctl routes import`` and ``export``: routes as StaticRoutes files of TwinCAT."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import json_option, plant_option

if TYPE_CHECKING:
    from eap.appliance.control_routes import ImportRow

_PATIENCE_S = 60.0
"""For a file with many routes, each of which is written to disk."""
_FILE = click.Path(path_type=Path, dir_okay=False, allow_dash=True)


@click.command("import", short_help="Add the routes of a StaticRoutes file.")
@click.argument("station")
@click.argument("file", type=_FILE)
@click.option("--dry-run", is_flag=True, help="Say what would be added, and add nothing.")
@plant_option
@json_option("Print one route a line, as an object.")
@click.pass_context
def import_routes(
    ctx: click.Context,
    station: str,
    file: Path,
    dry_run: bool,
    plant: str | None,
    as_json: bool,
) -> None:
    """Add the routes of FILE (StaticRoutes.xml of TwinCAT) to the router of STATION.

    Of each are taken name, address and NetID; type has to be TCP_IP.  A route that is there
    already is replaced.  FILE - is stdin.

    Exits with 1 when one of them could not be added; the others are.
    """
    rows = _import(station, _read(file), plant, dry_run=dry_run)
    if as_json:
        for row in rows:
            write_json(row)
    else:
        from eap.cli.routes_view import import_table

        write_tables([import_table(rows, is_done=not dry_run)])
    if any(row.reason for row in rows):
        ctx.exit(ExitCode.FAILED)


@click.command(short_help="Write the routes of a station as a StaticRoutes file.")
@click.argument("station")
@click.argument("file", type=_FILE, required=False, metavar="[FILE]")
@plant_option
def export(station: str, file: Path | None, plant: str | None) -> None:
    """Write the AMS/TCP routes of STATION to FILE, or to stdout, in the form of TwinCAT.

    Routes by other doors have no place in such a file; they are named on stderr.
    """
    from eap.appliance.commands.client import connect_station
    from eap.appliance.control_routes import Export, read_document
    from eap.appliance.durable import whole_file

    with connect_station(station, plant) as client:
        found = read_document(client.request("routes_export", station=station), Export)
    if file is None or str(file) == "-":
        write_text(found.xml, end="")
    else:
        with whole_file(file) as target:
            target.write(found.xml.encode())
        write_text(f"{file}: the AMS/TCP routes of {station}")
    if found.left_out:
        names = ", ".join(found.left_out)
        click.echo(f"{station}: no AMS/TCP routes, so left out: {names}", err=True)


def _read(file: Path) -> str:
    from eap.appliance.commands.route_lists import text_of_xml

    octets = sys.stdin.buffer.read() if str(file) == "-" else file.read_bytes()
    try:
        return text_of_xml(octets)
    except ValueError as exc:
        raise click.ClickException(f"{file}: {exc}") from None


def _import(station: str, xml: str, plant: str | None, *, dry_run: bool) -> list[ImportRow]:
    from eap.appliance.commands.client import connect_station
    from eap.appliance.control_routes import ImportRow, read_document

    with connect_station(station, plant) as client:
        answer = client.request_within(
            _PATIENCE_S, "routes_import", station=station, xml=xml, dry_run=dry_run
        )
    return read_document(answer, list[ImportRow])
