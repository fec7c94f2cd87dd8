"""``eapctl pd``: list, watch and set the process data of running stations."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from math import isfinite
from typing import TYPE_CHECKING, Any

import click

from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import (
    json_option,
    parse_assignment,
    parse_names,
    plant_option,
    station_option,
)
from eap.errors import ControlError

if TYPE_CHECKING:
    from eap.codec.values import DataType


@click.group()
def pd() -> None:
    """List, watch and set the process data of running stations."""


@pd.command("list", short_help="List every PD and every variable.")
@plant_option
@station_option
@json_option("One object a line: a PD, or the variables of a station that no PD carries.")
def list_pds(plant: str | None, station: str | None, as_json: bool) -> None:
    """List every PD with what identifies it, and every variable with its type and writer."""
    from eap.appliance.commands.client import connect
    from eap.cli.pd_view import pd_rows, pd_tables

    with ExitStack() as stack:
        rows: list[dict[str, Any]] = []
        for client in map(stack.enter_context, connect(plant, station)):
            for name in [station] if station else client.info.stations:
                rows += pd_rows(
                    name,
                    client.request("pd_list", station=name),
                    client.request("variables", station=name),
                )
    if as_json:
        for row in rows:
            write_json(row)
    else:
        write_tables(pd_tables(rows))


@pd.command()
@click.argument("names", nargs=-1, required=True, metavar="STATION [VAR]...")
@click.option("--count", type=click.IntRange(1), metavar="N", help="End after so many lines.")
@click.option(
    "--period",
    "period_ms",
    type=click.IntRange(10),
    default=100,
    show_default=True,
    metavar="MS",
    help="How often to look for changes.",
)
@plant_option
@json_option("One object a line.")
def watch(
    names: tuple[str, ...], count: int | None, period_ms: int, plant: str | None, as_json: bool
) -> None:
    """Print a line for each change of a variable, until Ctrl-C.

    All variables of STATION, or those named.  STATION/VAR names one of another station.  The first
    lines say what the values are now, later ones how many cycles were skipped before them.
    """
    from eap.cli.watching import SkippedCycles, changes

    wanted = parse_names(names)
    skipped = SkippedCycles(period_ms, partial(click.echo, err=True))
    write = skipped.without(write_json) if as_json else _write_change
    try:
        with ExitStack() as stack:
            stack.callback(skipped.close)
            stream = changes(stack, wanted, period_ms=period_ms, plant=plant)
            for number, change in enumerate(stream, 1):
                write(change)
                if number == count:
                    break
    except KeyboardInterrupt:
        return


@pd.command("set", context_settings={"ignore_unknown_options": True})
@click.argument("words", nargs=-1, required=True, metavar="STATION VAR VALUE")
@plant_option
@json_option("Print one object: what was written.")
def set_value(words: tuple[str, ...], plant: str | None, as_json: bool) -> None:
    """Set a variable that the plant file gives to the application.

    VALUE as the variable's type has it: 12, 0xC, -1.5e3, true, text, 1,2,3 for an array,
    hexadecimal digits for a raw block.
    """
    from eap.appliance.commands.client import connect_station
    from eap.codec import datatypes

    target, text = parse_assignment(words)
    with connect_station(target.station, plant) as client:
        variables = client.request("variables", station=target.station)
        kinds = {row["name"]: datatypes.parse(row["type"]) for row in variables}
        value: Any = text
        if kind := kinds.get(target.name):
            try:
                value = _to_json(kind, text)
            except ValueError as exc:
                raise ControlError(f"variable {target}: {exc}", code="value") from None
        client.request("write", station=target.station, values={target.name: value})
    if as_json:
        write_json({"station": target.station, "variable": target.name, "value": value})
    else:
        from eap.cli.pd_view import value_text

        write_text(f"{target} = {value_text(value)}")


def _to_json(kind: DataType, text: str) -> Any:
    """Read *text* as a value that the control protocol can carry; raise ValueError otherwise."""
    value = kind.parse_text(text)
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(number, float) and not isfinite(number) for number in numbers):
        raise ValueError(f"{text!r} cannot be set from here: expected a finite number")
    return kind.to_plain(value)


def _write_change(change: dict[str, Any]) -> None:
    from eap.cli.pd_view import change_line

    write_text(change_line(change))
