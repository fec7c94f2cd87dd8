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
    """Yield the stations of *rows*, each with its PDs and their variables."""
    from rich.text import Text

    for station in dict.fromkeys(row["station"] for row in rows):
        text = Text()
        text.append(f"{station}\n", style="bold")
        pds = [row for row in rows if row["station"] == station]
        variables = [variable for pd in pds for variable in pd["variables"]]
        name_width = max(len(variable["name"]) for variable in variables)
        type_width = max(len(_typed(variable)) for variable in variables)
        for pd in pds:
            text.append(f" {_heading(pd)}\n", style="cyan")
            for variable in pd["variables"]:
                text.append(
                    f"     {variable['name']:<{name_width}}  {_typed(variable):<{type_width}}"
                    f"  {variable['writer']}\n"
                )
        yield text


def _heading(pd: Row) -> str:
    """Say what identifies a PD, and where it comes from or goes to."""
    if pd["direction"] is None:
        return "·  in no PD"
    if pd["direction"] == "tx":
        arrow, way = "→", f"to {pd['destination']}"
    else:
        arrow, way = "←", f"from {pd['publisher'] or 'any publisher'}"
    line = f"{arrow}  {pd['name']}  id {pd['id']}, version {pd['version']}, {pd['port']} {way}"
    return f"{line}, polled by {pd['poll']}" if pd.get("poll") else line


def _typed(variable: Row) -> str:
    return f"{variable['type']} {variable['unit']}".rstrip()


def change_line(change: Row) -> str:
    """Return one change as a line: time, variable, value, cycle, quality, cycles not looked at."""
    at = change["time"][11:23]
    line = (
        f"{at}  {change['station']}/{change['variable']} = {value_text(change['value'])}"
        f"  cycle {change['cycle']}"
    )
    if "quality" in change:
        line = f"{line}  quality {words.quality(change['quality']) or 'never received'}"
    return f"{line}  ({change['skipped']} skipped)" if "skipped" in change else line


def value_text(value: Any) -> str:
    """Return a value as a person reads it, long ones cut short."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.7g}"  # what a REAL is exact to
    if isinstance(value, list):
        value = f"[{', '.join(map(value_text, value))}]"
    text = str(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}… ({len(text)} characters)"
