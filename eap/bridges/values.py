"""Variables that bridges serve, and their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import find_variable
from eap.control.protocol import VariableRow
from eap.patterns import match_names
from eap.pd.rules import MADE_SUFFIXES
from eap.pd.spec import Writer


class Quality(StrEnum):
    """Quality of a value."""

    GOOD = "good"
    STALE = "stale"
    """The last value: its PD, its station or the appliance does not send any more."""
    BAD = "bad"
    """It was never received."""


class BridgeVariable(NamedTuple):
    """Variable that a bridge serves, or a member or element of one.

    Attributes:
        station: Its station.
        variable: Its name there, such as ``axis.position``.
        type: Text of its type, for :func:`eap.codec.datatypes.parse`.
        unit: Its unit, empty without one.
        comment: Its comment.
        is_settable: True if the application writes it, so that :meth:`Bridge.write` may.
    """

    station: str
    variable: str
    type: str
    unit: str
    comment: str
    is_settable: bool

    @property
    def name(self) -> str:
        """``STATION/NAME``."""
        return f"{self.station}/{self.variable}"


class Sample(NamedTuple):
    """Value of a variable.

    Attributes:
        value: As in the control protocol: bool, int, float, str, list, or dict of a struct; None
            for a number that JSON cannot carry.
        quality: Its quality.
        time_ns: Unix time at which its data was made: of the cycle, less the age of received data.
    """

    value: Any
    quality: Quality
    time_ns: int

    @property
    def has_value(self) -> bool:
        """False if there is nothing to pass on; null alone is a number that JSON cannot carry."""
        return self.value is not None or self.quality is not Quality.BAD


def select(
    rows: Iterable[VariableRow], station: str, patterns: Iterable[str]
) -> list[BridgeVariable]:
    """Return the variables of a station that fit *patterns*, in the order of the station.

    Args:
        rows: All variables of the station.
        station: Its name.
        patterns: ``STATION/NAME``, with ``*`` for any text; without, it may name a member.
            Patterns do not fit the variables that control frames and PDs.
    """
    by_name = {row.name: row for row in rows}
    names = [f"{station}/{name}" for name in by_name if not name.endswith(MADE_SUFFIXES)]
    found: dict[str, BridgeVariable] = {}
    for pattern in patterns:
        chosen = match_names(pattern, names) if "*" in pattern else [pattern]
        for name in chosen:
            variable = name.removeprefix(f"{station}/")
            if variable != name and (made := _variable(by_name, station, variable)) is not None:
                found[variable] = made
    # Members and elements are no variables of the station: they come behind these.
    order = {name: position for position, name in enumerate(by_name)}
    return sorted(found.values(), key=lambda each: order.get(each.variable, len(order)))


def _variable(
    rows: Mapping[str, VariableRow], station: str, variable: str
) -> BridgeVariable | None:
    def type_of(name: str) -> datatypes.DataType | None:
        row = rows.get(name)
        return None if row is None else datatypes.parse(row.type)

    try:
        found = find_variable(variable, type_of)
    except ValueError:
        return None
    if found is None:
        return None
    row, part = rows[found[0]], found[1]
    is_settable = row.writer == Writer.APPLICATION
    return BridgeVariable(station, variable, part.kind.text, row.unit, row.comment, is_settable)
