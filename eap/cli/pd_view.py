"""Process data as records and their text views: the list of PDs, changes of variables.

Each station has a connection to itself; several are read by a thread each, because a wait for two
sockets with one buffered reader misses data that the buffer already holds.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from queue import SimpleQueue
from typing import Any, TypeAlias

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from eap.cli.output import (
    Column,
    Styled,
    TextTable,
    offset_text,
    value_text,
)
from eap.codec.datatypes import parse, parts_of
from eap.codec.structures import member_type_name
from eap.control.protocol import ValuesEvent, VariableRow
from eap.errors import EapError
from eap.ops.client import connect_station
from eap.pd.report import MemberRow, PdRow, PdRowVariable
from eap.quantities import quality


class UncarriedVariables(Struct, frozen=True):
    """Variables of a station that no PD carries, in the form of a PD."""

    station: str
    direction: None
    name: None
    variables: list[PdRowVariable]


ListedPd: TypeAlias = PdRow | UncarriedVariables


class ValueChange(Struct, frozen=True, kw_only=True):
    """Change of a variable.

    Attributes:
        station: Name of its station.
        variable: Its name.
        value: As JSON has it.
        time: ISO 8601.
        cycle: Of the station.
        quality: Of received variables, in units of 100 us; None before the first time.
        skipped: Cycles since the station's change before that were not looked at, if any.
    """

    station: str
    variable: str
    value: Any
    time: str
    cycle: int
    quality: int | UnsetType | None = UNSET
    skipped: int | UnsetType = UNSET


def listed_pds(
    station: str, pds: Sequence[PdRow], variables: Sequence[VariableRow]
) -> Iterator[ListedPd]:
    """Yield the PDs of *station*, then one row for the variables that none carries."""
    yield from pds
    carried = {variable.name for pd in pds for variable in pd.variables}
    rest = [
        PdRowVariable(variable.name, parse(variable.type).name, variable.unit, variable.writer)
        for variable in variables
        if variable.name not in carried
    ]
    if rest:
        yield UncarriedVariables(station, None, None, rest)


def with_members(rows: Iterable[ListedPd], variables: Sequence[VariableRow]) -> list[ListedPd]:
    """Return *rows* with the members of all structs."""
    types = {each.name: parse(each.type) for each in variables}

    def expanded(variable: PdRowVariable) -> PdRowVariable:
        members = [
            MemberRow(
                f"{variable.name}{path}",
                member_type_name(part.kind),
                part.bit_offset,
                part.kind.bit_length,
            )
            for path, part in parts_of(types[variable.name])
        ]
        return replace(variable, members=members or UNSET)

    return [replace(row, variables=[expanded(each) for each in row.variables]) for row in rows]


def pd_table(rows: Iterable[ListedPd]) -> Iterator[TextTable]:
    """Yield the table of PDs: a heading for each station, a line for each variable of a PD."""
    table = TextTable(
        "",
        "PD",
        Column("ID", is_number=True),
        Column("Version", rank=4, is_number=True),
        Column("Port", rank=3),
        Column("To or from", rank=1, wraps=True),
        "Variable",
        Column("Type", rank=2),
        Column("Writer", rank=5),
    )
    station = ""
    for row in rows:
        if row.station != station:
            station = row.station
            table.add_row("", Styled(station, style="bold"))
        own = _identification(row)
        for variable in row.variables:
            kind = f"{variable.type} {variable.unit}".rstrip()
            table.add_row(*own, variable.name, kind, variable.writer)
            own = ("",) * len(own)
            for member in variable.members or ():
                name = f"  {member.name.removeprefix(variable.name)}"
                table.add_row(*own, name, f"{member.type} at {offset_text(member.bit_offset)}", "")
        if not row.variables:
            table.add_row(*own)
    yield table


def _identification(row: ListedPd) -> tuple[str, ...]:
    """Return direction, name, ID, version, port, and the destination or publisher of a PD."""
    if isinstance(row, UncarriedVariables):
        return "", "in no PD", "", "", "", ""
    if row.direction == "tx":
        arrow, remote = "→", row.destination or ""
    else:
        arrow, remote = "←", row.publisher or "any publisher"
    polled = f", polled by {row.poll}" if row.poll else ""
    return arrow, row.name, str(row.id), str(row.version), row.port, f"{remote}{polled}"


def changes(
    stack: ExitStack, names: Mapping[str, Sequence[str]], *, period_ms: int, plant: str | None
) -> Iterator[ValueChange]:
    """Yield each change of the variables *names* of each station; none means all.

    Connections are closed by *stack*.

    Raises:
        ControlError: a station or variable is not there, or an appliance went away.
    """
    events = [
        stack.enter_context(connect_station(station, plant)).events(
            station=station, names=list(variables), period_ms=period_ms, on="change"
        )
        for station, variables in names.items()
    ]
    for event in events[0] if len(events) == 1 else _merge(events):
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        for variable, value in event.values.items():
            yield ValueChange(
                station=event.station,
                variable=variable,
                value=value,
                time=now,
                cycle=event.cycle,
                quality=event.quality.get(variable, UNSET),
                skipped=event.skipped or UNSET,
            )


class SkippedCycles:
    """Count of the cycles that were skipped, for stderr beside JSON lines.

    Args:
        period_ms: Polling period of the values.
        write: Prints a line.
    """

    def __init__(self, period_ms: int, write: Callable[[str], None]) -> None:
        self._period_ms = period_ms
        self._write = write
        self._last: dict[str, int] = {}
        self._totals: dict[str, int] = {}

    def count(self, change: ValueChange) -> ValueChange:
        """Return *change* without ``skipped``; write the first one of each station."""
        skipped, station, cycle = change.skipped or 0, change.station, change.cycle
        if skipped and self._last.get(station) != cycle:  # else another variable of that event
            if station not in self._totals:
                self._write(
                    f"{station}: {skipped} cycles before cycle {cycle} skipped: values are"
                    f" polled every {self._period_ms} ms; choose a shorter --period"
                )
            self._totals[station] = self._totals.get(station, 0) + skipped
            self._last[station] = cycle
        return replace(change, skipped=UNSET)

    def close(self) -> None:
        """Write the total of each station."""
        for station, total in self._totals.items():
            self._write(f"{station}: {total} cycles skipped in all")


def _merge(streams: Sequence[Iterator[ValuesEvent]]) -> Iterator[ValuesEvent]:
    """Yield the events of all *streams* as they come; the first error ends it."""
    arrivals: SimpleQueue[ValuesEvent | Exception] = SimpleQueue()

    def forward(stream: Iterator[ValuesEvent]) -> None:
        try:
            for event in stream:
                arrivals.put(event)
        except (EapError, OSError, ValueError) as exc:  # ValueError: closed at the end
            arrivals.put(exc)

    for stream in streams:
        # Daemons: a thread that waits for an event must not keep the process alive after Ctrl-C.
        threading.Thread(target=forward, args=(stream,), daemon=True).start()
    while not isinstance(arrival := arrivals.get(), Exception):
        yield arrival
    raise arrival


def change_lines(stream: Iterable[ValueChange]) -> Iterator[str]:
    """Yield each change as a line: time, variable, value, cycle, quality, skipped cycles."""
    for change in stream:
        line = (
            f"{change.time[11:23]}  {change.station}/{change.variable} ="
            f" {value_text(change.value)}  cycle {change.cycle}"
        )
        if change.quality is not UNSET:
            line = f"{line}  quality {quality(change.quality) or 'never received'}"
        yield f"{line}  ({change.skipped} skipped)" if change.skipped else line
