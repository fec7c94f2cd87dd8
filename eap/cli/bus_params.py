"""How things on a bus are written on a command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from eap.cli.params import CommandT
from eap.ids import ObjectId

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType


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


def parse_entry(text: str) -> ObjectId:
    """Read ``INDEX[:SUB]`` in hexadecimal; raise BadParameter with an example otherwise."""
    try:
        return ObjectId.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


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
