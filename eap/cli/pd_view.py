"""Process data as rows for programs, and as tables and lines for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from eap.cli import words

if TYPE_CHECKING:
    from rich.console import RenderableType

Row = Mapping[str, Any]

_SHOWN = 48
"""Characters of a value in a line for people."""


def pd_rows(station: str, pds: Sequence[Row], variables: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """Yield the PDs of *station*, then one row without a PD for the variables that none carries."""
    yield from map(dict, pds)
    carried = {variable["name"] for pd in pds for variable in pd["variables"]}
    rest = [
        {key: variable[key] for key in ("name", "type", "unit", "writer")}
        for variable in variables
        if variable["name"] not in carried
    ]
    if rest:
        yield {"station": station, "direction": None, "name": None, "variables": rest}


def pd_tables(rows: Sequence[Row]) -> Iterator[RenderableType]:
    """Yield one table for each station of *rows*."""
    from rich import box
    from rich.table import Table

    for station in dict.fromkeys(row["station"] for row in rows):
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        table.title, table.title_justify, table.title_style = station, "left", "bold"
        for heading in ("", "PD", "Id", "Version", "Port", "From / to", "Variable", "Type"):
            table.add_column(heading, overflow="fold")
        table.add_column("Writer")
        for row in rows:
            if row["station"] == station:
                _add_pd(table.add_row, row)
        yield table


def _add_pd(add_row: Any, row: Row) -> None:
    """Add a line for each variable; what identifies the PD stands in the first."""
    if row["direction"] is None:
        own = ["", "(in no PD)", "", "", "", ""]
    else:
        is_sent = row["direction"] == "tx"
        peer = row["destination"] if is_sent else row["publisher"] or "any"
        arrow = "→" if is_sent else "←"
        own = [arrow, row["name"], str(row["id"]), str(row["version"]), row["port"], peer]
    for variable in row["variables"]:
        unit = f" [{variable['unit']}]" if variable["unit"] else ""
        add_row(*own, variable["name"] + unit, variable["type"], variable["writer"])
        own = [""] * 6


def change_line(change: Row) -> str:
    """Return one change as a line: time, variable, value, cycle, quality of received ones."""
    at = change["time"][11:23]
    line = (
        f"{at}  {change['station']}/{change['variable']} = {_short(change['value'])}"
        f"  cycle {change['cycle']}"
    )
    if "quality" not in change:
        return line
    return f"{line}  quality {words.quality(change['quality']) or 'never received'}"


def _short(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}… ({len(text)} characters)"
