"""Rows of values, as both kinds of recordings yield them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from eap.codec.basetypes import Boolean, DataType
from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.errors import ConfigError
from eap.patterns import compile_patterns, is_pattern
from eap.recording.messages import StationMessages
from eap.suggest import nearest_in_any_case


class RawRow(NamedTuple):
    """Values of one source at one time as they are in the file: a message, or the data of a PD."""

    time_ns: int
    source: int
    cycle: int
    data: bytes


class TimeWindow(NamedTuple):
    """Part of a recording in Unix time; None has no limit."""

    from_ns: int | None = None
    until_ns: int | None = None

    def __contains__(self, at_ns: object) -> bool:
        return (
            isinstance(at_ns, int)
            and (self.from_ns is None or at_ns >= self.from_ns)
            and (self.until_ns is None or at_ns <= self.until_ns)
        )


ALL = TimeWindow()


class ValueColumn(NamedTuple):
    """One value over time: *name* is ``STATION/VARIABLE`` with the path to a part.

    *kind* is its type, *variable* and *type* are those of the whole variable.
    """

    name: str
    variable: str
    kind: DataType
    type: str
    unit: str


class ValueSource(NamedTuple):
    """Values that a recording has together: of a station, or of one PD."""

    station: str
    columns: tuple[ValueColumn, ...]


def source_of(messages: StationMessages) -> ValueSource:
    """Return the source with the leaves of *messages*, in their order."""
    station = messages.station
    return ValueSource(
        station,
        tuple(
            ValueColumn(
                f"{station}/{leaf.path}",
                f"{station}/{owner.name}",
                leaf.kind,
                owner.type,
                owner.unit,
            )
            for leaf, owner in zip(messages.leaves, messages.owners, strict=True)
        ),
    )


class ValueRow(NamedTuple):
    """Values of one source at one time, in the order of its columns; numbers, texts and bytes."""

    time_ns: int
    source: int
    cycle: int
    values: list[Any]


def plain_value(kind: DataType, value: Any) -> Any:
    """Return a leaf's value as files of text have it: enumerations by name, times as texts."""
    if isinstance(kind, Enumeration | Timed):
        # The file has the wire value as a number of 4 or 8 bytes, the type may have fewer.
        octets = int(value).to_bytes(8, "little", signed=value < 0)[: kind.size]
        return kind.to_plain(kind.decode(octets, 0))
    return value.hex() if isinstance(value, bytes) else value


def number_of(kind: DataType, value: Any) -> float | None:
    """Return a leaf's value as a number to plot; None for texts and bytes."""
    if isinstance(kind, Boolean):
        return float(bool(value))
    return None if isinstance(value, str | bytes) else float(value)


def select(
    sources: Mapping[int, ValueSource], patterns: Sequence[str]
) -> dict[int, dict[int, ValueColumn]]:
    """Return the columns that *patterns* name, by source and position in its rows.

    A pattern is a station, a variable, a part of one, or has ``*`` and ``?`` for any characters.
    A variable without its station is that of any station; no pattern takes all.

    Raises:
        ConfigError: a pattern names nothing.
    """
    found: dict[int, dict[int, ValueColumn]] = {}
    unused = {pattern: _matcher(pattern) for pattern in patterns}
    matchers = list(unused.items())
    for number, source in sources.items():
        for position, column in enumerate(source.columns):
            names = [name for name, matches in matchers if matches(column)]
            for name in names:
                # A misspelled name is reported: a file without its column would be found much
                # later.
                unused.pop(name, None)
            if names or not patterns:
                found.setdefault(number, {})[position] = column
    if unused:
        known = {each.variable: None for source in sources.values() for each in source.columns}
        name = next(iter(unused))
        raise ConfigError(f"no recorded variable {name!r}{_hint(name, list(known))}")
    return found


def _hint(name: str, known: list[str]) -> str:
    near = nearest_in_any_case(name, known)
    if near:
        return f", did you mean {near}?"
    more = f" and {len(known) - 4} more" if len(known) > 5 else ""
    listed = ", ".join(known[: 4 if more else 5])
    return f"; recorded variables: {listed}{more}" if known else ": there are no variables in it"


def _matcher(pattern: str) -> Callable[[ValueColumn], bool]:
    parts = (f"{pattern}.", f"{pattern}[")
    wild = compile_patterns([pattern]) if is_pattern(pattern) else None

    def matches(column: ValueColumn) -> bool:
        names = [column.name, column.variable]
        if "/" not in pattern:
            # STATION takes all of its variables, and a lone variable is that of any station.
            station, _, name = column.name.partition("/")
            names = [name, column.variable.partition("/")[2], station]
        if wild is not None:
            return any(map(wild, names))
        return pattern in names or names[0].startswith(parts)

    return matches
