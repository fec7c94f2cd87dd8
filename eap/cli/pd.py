"""``eapctl pd``: list, watch and set the process data of running stations."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import click

from eap.cli.completion import complete_variables
from eap.cli.group import CommandGroup
from eap.cli.output import Renderer, json_option, value_text
from eap.cli.params import plant_option, station_option

if TYPE_CHECKING:
    from eap.cli.pd_view import ListedPd
    from eap.ops.client import ControlClient


class VariableName(NamedTuple):
    """A variable of a station, written ``STATION/NAME``."""

    station: str
    name: str

    def __str__(self) -> str:
        return f"{self.station}/{self.name}"


def parse_names(words: tuple[str, ...]) -> dict[str, list[str]]:
    """Read ``STATION [VAR…]`` or ``STATION/VAR…``, and return the variables of each station.

    No variables means all of the station's.

    Raises:
        click.UsageError: a name has no station.
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
            raise click.UsageError(f"{word!r} has no station: write STATION/{word}")
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


@click.group(cls=CommandGroup)
def pd() -> None:
    """List, watch and set the process data of running stations."""


@pd.command("list", short_help="List every PD and every variable.")
@plant_option
@station_option
@click.option("--members", is_flag=True, help="List the members of structs too.")
@json_option("Print one object per line: a PD, or the variables of a station in no PD.")
def list_pds(plant: str | None, station: str | None, members: bool, output: Renderer) -> None:
    """List every PD with ID, version, port and address, and every variable with type and writer."""
    from eap.cli.pd_view import listed_pds, pd_table, with_members
    from eap.control.protocol import PD_LIST, VARIABLES
    from eap.ops.client import call_each, connect

    def rows_of(client: ControlClient) -> list[ListedPd]:
        rows: list[ListedPd] = []
        for name in [station] if station else client.info.stations:
            pds = client.call(PD_LIST, station=name)
            variables = client.call(VARIABLES, station=name)
            found = list(listed_pds(name, pds, variables))
            rows += with_members(found, variables) if members else found
        return rows

    with ExitStack() as stack:
        clients = [stack.enter_context(each) for each in connect(plant, station)]
        found, silent = call_each(clients, rows_of)
    output.show_rows([row for rows in found for row in rows], pd_table)
    if silent:
        raise silent[0]


@pd.command()
@click.argument(
    "names",
    nargs=-1,
    required=True,
    metavar="STATION [VAR]...",
    shell_complete=complete_variables,
)
@click.option("--count", type=click.IntRange(1), metavar="N", help="End after N lines.")
@click.option(
    "--period",
    "period_ms",
    type=click.IntRange(10),
    default=100,
    show_default=True,
    metavar="MS",
    help="Polling period for changes.",
)
@plant_option
@json_option("Print one object per line.")
def watch(
    names: tuple[str, ...], count: int | None, period_ms: int, plant: str | None, output: Renderer
) -> None:
    """Print a line for each change of a variable, until Ctrl-C.

    Watches all variables of STATION, or only the named ones; STATION/VAR names one of a further
    station.  The first lines show the present values; later lines also show the number of cycles
    skipped before them.
    """
    from eap.cli.pd_view import SkippedCycles, change_lines, changes

    wanted = parse_names(names)
    try:
        with ExitStack() as stack:
            stream = changes(stack, wanted, period_ms=period_ms, plant=plant)
            if count is not None:
                stream = islice(stream, count)
            if output.is_json:
                # On stderr: each JSON line is a change, and the number would repeat in all of one
                # event.
                skipped = SkippedCycles(period_ms, partial(click.echo, err=True))
                stack.callback(skipped.close)
                stream = map(skipped.count, stream)
            output.show_rows(stream, change_lines)
    except KeyboardInterrupt:
        return


@pd.command("set", context_settings={"ignore_unknown_options": True})
@click.argument(
    "words",
    nargs=-1,
    required=True,
    metavar="STATION VAR VALUE",
    shell_complete=complete_variables,
)
@plant_option
@json_option("Print one object: what was written.")
def set_value(words: tuple[str, ...], plant: str | None, output: Renderer) -> None:
    """Set a variable whose writer is the application.

    VALUE is a literal of the variable's type: 12, 0xC, -1.5e3, true, text, 1,2,3 for an array,
    hexadecimal digits for a raw block, T#1m30s for a time, the name of a value of an enumeration,
    '{position: 5, state: On}' for a struct.  VAR may be a part of a variable: axis.position or
    table[2].x.
    """
    from eap.ops.client import write_variable

    target, text = parse_assignment(words)
    done = write_variable(target.station, target.name, text, plant)
    output.show(done, lambda each: f"{target} = {value_text(each.value)}")
