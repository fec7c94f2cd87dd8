"""``eapctl gw HOST od``: the whole dictionary of a master or a slave, as a tree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from eap.cli.bus_place import BusCommand, Place, bus_options, open_session
from eap.cli.output import write_json, write_tables
from eap.cli.params import json_option

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any

    from rich.tree import Tree


@click.command(cls=BusCommand, short_help="Show all objects of the master or a slave as a tree.")
@bus_options
@click.argument("slave", default="0", metavar="[SLAVE]")
@json_option("Print one object a line.")
def od(slave: str, bus: Place, as_json: bool) -> None:
    """Show every object with its entries and values; of the master if SLAVE is left out."""
    from eap.appliance.commands.bus_sdo import dump_entries

    with open_session(bus) as session:
        rows = dump_entries(session, slave)
        if as_json:
            for row in rows:
                write_json(row)
            return
        tree = _tree(session.find(slave).name, rows)
    write_tables([tree])


def _tree(name: str, rows: Iterable[dict[str, Any]]) -> Tree:
    from rich.text import Text
    from rich.tree import Tree

    from eap.cli.bus_view import dumped_value

    tree = Tree(Text(name))
    branch, index = tree, None
    for row in rows:
        if row["index"] != index:
            index = row["index"]
            branch = tree.add(Text(f"0x{index:04X} {row['object']}"))
        branch.add(Text(f"{row['subindex']:02X} {row['name']}: ") + dumped_value(row))
    return tree
