"""Options, arguments and parameter types that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import click

from eap.cli.output import Renderer
from eap.ids import ObjectId

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType

CommandT = TypeVar("CommandT", bound=Callable[..., Any])

MIN_CYCLE_US = 100
MAX_CYCLE_US = 60_000_000

ANSWER_MARGIN_S = 5.0
"""Time that a command waits for its appliance beyond the time that the appliance itself waits."""

PLANT_FILE = click.Path(path_type=Path)
"""Path of a plant file; the loader says why it cannot be read."""


class VariableName(NamedTuple):
    """A variable of a station, written ``STATION/NAME``."""

    station: str
    name: str

    def __str__(self) -> str:
        return f"{self.station}/{self.name}"


def json_option(text: str) -> Callable[[CommandT], CommandT]:
    """Return the decorator that adds ``--json``; the function gets *output*.

    Args:
        text: Help text: the form of the JSON result.
    """
    return click.option("--json", "output", is_flag=True, callback=_to_output, help=text)


def _to_output(ctx: click.Context, param: click.Parameter, is_json: bool) -> Renderer:
    del ctx, param
    return Renderer(is_json=is_json)


def plant_option(command: CommandT) -> CommandT:
    """Add ``--plant``, which chooses among running appliances."""
    return click.option("--plant", metavar="NAME", help="Only the appliance that runs this plant.")(
        command
    )


def station_option(command: CommandT) -> CommandT:
    """Add ``--station``, which chooses among running stations."""
    return click.option("--station", metavar="NAME", help="Only this station.")(command)


def parse_names(words: tuple[str, ...]) -> dict[str, list[str]]:
    """Read ``STATION [VAR…]`` or ``STATION/VAR…``, and return the variables of each station.

    No variables means all of the station's.

    Raises:
        click.UsageError: a name without a station stands before any station.
    """
    names: dict[str, list[str]] = {}
    current = ""
    for word in words:
        station, slash, name = word.partition("/")
        if slash:
            if not station or not name:
                raise click.UsageError(f"{word!r} is not a variable (STATION/NAME)")
            names.setdefault(station, []).append(name)
        elif current:
            names[current].append(word)
        elif names:
            raise click.UsageError(
                f"{word!r} follows {words[0]!r} without its station: write STATION/{word}"
            )
        else:
            current = word
            names[current] = []
    return names


def parse_assignment(words: tuple[str, ...]) -> tuple[VariableName, str]:
    """Read ``STATION VAR VALUE`` or ``STATION/VAR VALUE``; raise click.UsageError otherwise."""
    if len(words) == 3 and "/" not in words[0]:
        return VariableName(words[0], words[1]), words[2]
    if len(words) == 2:
        station, _, name = words[0].partition("/")
        if station and name:
            return VariableName(station, name), words[1]
    raise click.UsageError("expected STATION VAR VALUE (or STATION/VAR VALUE)")


def parse_cycle(ctx: click.Context, param: click.Parameter, text: str | None) -> int | None:
    """Return the microseconds of a device cycle given in milliseconds, as an option's callback.

    Raises:
        click.BadParameter: a device cannot have such a cycle.
    """
    del ctx, param
    if text is None:
        return None
    try:
        cycle_us = float(text) * 1000
    except ValueError:
        cycle_us = 0.0
    if not MIN_CYCLE_US <= cycle_us <= MAX_CYCLE_US or cycle_us % 1:
        raise click.BadParameter(f"{text!r} is no device cycle: expected 0.1 to 60000 milliseconds")
    return int(cycle_us)


def examples(*lines: str) -> str:
    """Return the epilog of a command: examples of calls."""
    return "\n  ".join(("\b\nExamples:", *lines))


def number_up_to(limit: int) -> Callable[[str | int], int]:
    """Return the parser of a whole number, hexadecimal or decimal; it raises BadParameter."""

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
    """Read a data type; raise BadParameter with a suggestion otherwise."""
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
