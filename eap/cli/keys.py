"""``eapctl keys``: files with the keys of signed process data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import CommandGroup
from eap.cli.output import Column, Renderer, TextTable, json_option
from eap.cli.params import examples

if TYPE_CHECKING:
    from eap.ops.pd_keys import KeyInfo

_FILE = click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
_NUMBER = click.argument("number", type=click.IntRange(1, 0xFFFF))
_JSON = json_option("Print one key per line, without telling it.")


@click.group(
    cls=CommandGroup,
    epilog=examples(
        "eapctl keys new plant.keys      # on one host; copy the file to the others",
        "eapctl keys new plant.keys      # a change: add a key, copy the file,",
        "eapctl keys use plant.keys 2    # let it sign, copy the file,",
        "eapctl keys remove plant.keys 1 # and remove the old one",
    ),
)
def keys() -> None:
    """Make and change files with the keys of signed process data.

    A running plant follows its file within a second.
    """


@keys.command("list")
@_FILE
@_JSON
def list_(file: Path, output: Renderer) -> None:
    """List the keys of FILE by their fingerprints."""
    from eap.ops.pd_keys import list_keys

    output.show_rows(list_keys(file), _tables)


@keys.command()
@_FILE
@_JSON
def new(file: Path, output: Renderer) -> None:
    """Add a new key to FILE, which is made if there is none.

    The first key signs; each other is accepted, and signs after ``eapctl keys use``.
    """
    from eap.ops.pd_keys import add_key

    output.show_rows(add_key(file), _tables)


@keys.command()
@_FILE
@_NUMBER
@_JSON
def use(file: Path, number: int, output: Renderer) -> None:
    """Sign with key NUMBER of FILE.

    All receivers need it in their files before.
    """
    from eap.ops.pd_keys import sign_with

    output.show_rows(sign_with(file, number), _tables)


@keys.command()
@_FILE
@_NUMBER
@_JSON
def remove(file: Path, number: int, output: Renderer) -> None:
    """Remove key NUMBER from FILE, so that it is accepted no more."""
    from eap.ops.pd_keys import remove_key

    output.show_rows(remove_key(file, number), _tables)


def _tables(rows: Iterable[KeyInfo]) -> Iterator[TextTable]:
    table = TextTable(Column("Key", is_number=True), "Fingerprint", "Use")
    for row in rows:
        table.add_row(str(row.number), row.fingerprint, "signs" if row.signs else "accepted")
    yield table
