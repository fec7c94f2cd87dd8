"""``eapctl addresses``: addresses of variables in data blocks (S7) and registers (Modbus)."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import Column, Renderer, TextTable, json_option
from eap.cli.params import PLANT_FILE, examples

if TYPE_CHECKING:
    from eap.ops.addresses import AddressRow

_ACCESS = {"read": "read", "write": "read, write", "source": "from there", "target": "to there"}


@click.command(epilog=examples("eapctl addresses plant.yaml", "eapctl addresses plant.yaml --csv"))
@click.argument("plant", type=PLANT_FILE)
@click.option("--csv", "is_csv", is_flag=True, help="Print CSV, for the engineer of a panel.")
@json_option("Print one object per line: a variable at its address.")
def addresses(plant: Path, is_csv: bool, output: Renderer) -> None:
    """Show where the variables of the plant file PLANT are in data blocks and registers.

    First those that the plant serves to S7 and Modbus clients, with the addresses that it computes,
    then those in controllers, which are read from there or written to there.
    """
    from eap.ops.addresses import list_addresses, write_addresses  # yaml; --help must not wait

    rows = list_addresses(plant)
    if is_csv and not output.is_json:
        write_addresses(rows, sys.stdout)
    else:
        output.show_rows(rows, _view)


def _view(rows: Iterable[AddressRow]) -> Iterator[TextTable | str]:
    table = TextTable(
        "Bridge", "At", "Address", Column("Type"), "Variable", "Access", Column("Unit", rank=1)
    )
    is_empty = True
    for row in rows:
        is_empty = False
        access = _ACCESS[row.access]
        table.add_row(row.bridge, row.at, row.address, row.type, row.variable, access, row.unit)
    yield "no variables in data blocks or registers" if is_empty else table
