"""Options and parameter types that several commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click

CommandT = TypeVar("CommandT", bound=Callable[..., Any])

MIN_CYCLE_US = 100
MAX_CYCLE_US = 60_000_000

ANSWER_MARGIN_S = 5.0
"""How much longer a command waits for its appliance than that waits for somebody else."""

PLANT_FILE = click.Path(path_type=Path)
"""A plant file; whether it can be read is for the loader to say, in its own words."""


class VariableName(NamedTuple):
    """A variable of a station, written ``STATION/NAME``."""

    station: str
    name: str

    def __str__(self) -> str:
        return f"{self.station}/{self.name}"


def json_option(text: str) -> Callable[[CommandT], CommandT]:
    """Return the decorator that adds ``--json``; *text* says what comes out."""
    return click.option("--json", "as_json", is_flag=True, help=text)


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
    """Return what to show below the options of a command: some ways to call it."""
    return "\n  ".join(("\b\nExamples:", *lines))
