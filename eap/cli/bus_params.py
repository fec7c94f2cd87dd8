"""How things on a bus are written on a command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import click

from eap.cli.params import CommandT

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType

Entry: TypeAlias = tuple[int, int]
"""Index and subindex."""


def number_up_to(limit: int) -> Callable[[str | int], int]:
    """Return what reads a whole number in hex or decimal, or raises BadParameter."""

    def parse(text: str | int) -> int:
        try:
            number = text if isinstance(text, int) else int(text, 0)
        except ValueError:
            number = -1
        if not 0 <= number <= limit:
            raise click.BadParameter(f"{text!r} is not a number from 0 to 0x{limit:X}")
        return number

    return parse


def parse_entry(text: str) -> Entry:
    """Read ``INDEX[:SUB]`` in hex or decimal; raise BadParameter with an example otherwise.

    Zeros in front, as in 0xD000:07, mean nothing.
    """
    index, _, subindex = text.partition(":")
    try:
        numbers = int(index, 0), int(subindex or "0", 10 if subindex.isdecimal() else 0)
    except ValueError:
        numbers = -1, 0
    if not 0 <= numbers[0] <= 0xFFFF or not 0 <= numbers[1] <= 0xFF:
        raise click.BadParameter(f"{text!r} is not INDEX[:SUB], such as 0x1018:1")
    return numbers


def parse_type(text: str) -> DataType:
    """Look a data type up; raise BadParameter with what comes near otherwise."""
    from eap.codec import datatypes

    try:
        return datatypes.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def parse_octets(text: str) -> bytes:
    """Read hexadecimal digits; raise BadParameter if there is anything else."""
    try:
        return bytes.fromhex(text.removeprefix("0x"))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not pairs of hexadecimal digits") from None


def slave_argument(command: CommandT) -> CommandT:
    """Add the argument SLAVE."""
    return click.argument("slave", metavar="SLAVE")(command)
