"""``eapctl types``: data types of a plant file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import (
    Column,
    Renderer,
    Styled,
    TextTable,
    json_option,
    offset_text,
)
from eap.cli.params import PLANT_FILE, examples
from eap.quantities import count

if TYPE_CHECKING:
    from eap.ops.types import ShownType


@click.command(epilog=examples("eapctl types plant.yaml", "eapctl types plant.yaml ST_Axis"))
@click.argument("plant", type=PLANT_FILE)
@click.argument("name", required=False, default="")
@json_option("Print one object per line: a type with its layout.")
def types(plant: Path, name: str, output: Renderer) -> None:
    """Show the data types that the plant file PLANT defines, or the type NAME.

    A struct is shown with offset and size of each member, padding included; of the types in files
    those that a variable uses, and NAME.
    """
    from eap.ops.types import list_types  # yaml; --help must not wait

    output.show_rows(list_types(plant, name), _tables)


def _tables(found: Iterable[ShownType]) -> Iterator[TextTable | Styled | str]:
    empty = True
    for each in found:
        if not empty:
            yield ""
        empty = False
        size = f"{each.size} bytes, aligned to {each.alignment}"
        yield Styled(f"{each.name}  {_summary(each)}, {size}", style="bold")
        if each.layout:
            yield _layout(each)
        for value, number in each.values.items():
            yield f"  {value} = {number}"
    if empty:
        yield "no types of its own"


def _summary(each: ShownType) -> str:
    if each.kind == "alias":
        return f"another name of {each.of}"
    members = sum(1 for row in each.layout if row.name)
    parts = count(members, "member") if members else count(len(each.values), "value")
    return f"{each.kind} of {parts}"


def _layout(each: ShownType) -> TextTable:
    table = TextTable(
        Column("Offset", is_number=True), Column("Size", is_number=True), "Member", "Type"
    )
    for row in each.layout:
        name = row.name or Styled("(padding)", style="dim")
        size = count(row.bits, "bit") if row.bits % 8 else str(row.bits // 8)
        table.add_row(offset_text(row.bit_offset), size, name, row.type)
    return table
