"""The key ``record`` of a plant file: checks, and the records that the recorders get."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from msgspec.structs import replace

from eap.config.files import whole_path
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index
from eap.config.record_sections import RecordKind, RecordSection
from eap.config.record_texts import (
    COUNTERS,
    STORE_SCHEMES,
    Distance,
    RecordTimes,
    find_contradiction,
    matcher,
    parse_every,
    parse_ring,
    parse_split,
    parse_time,
)
from eap.config.selection import VariableNames
from eap.expressions import Condition
from eap.suggest import suggest

_PATTERN = "STATION, STATION/VARIABLE or STATION/PD, with * for any text"
_PORT_PATTERN = "STATION or STATION/PORT, with * for any text"


def resolved_recordings(
    sections: Sequence[RecordSection], folder: Path
) -> tuple[RecordSection, ...]:
    """Return *sections* with the paths of their folders from *folder* on."""
    return tuple(replace(each, folder=whole_path(folder, each.folder)) for each in sections)


def records_of(section: RecordSection, stations: Iterable[str]) -> bool:
    """Return whether a recording selects something of one of *stations*."""
    is_selected = matcher([each.partition("/")[0] for each in section.patterns])
    return any(is_selected(f"{station}/") for station in stations)


def check_recordings(index: Index, report: FindingReport) -> None:
    """Report every invalid key of ``record``."""
    if not index.plant.record:
        return
    variables = VariableNames(index, report)
    names: set[str] = set()
    for section in index.plant.record:
        if not section.name or re.search(r"[\s/]", section.name):
            message = f"recording {section.name!r}"
            report.add(f"{section.at}.name", message, "a name without spaces and slashes")
        elif section.name in names:
            message = f"recording {section.name} is there twice"
            report.add(f"{section.at}.name", message, "each name once")
        names.add(section.name)
        _RecordCheck(index, report, variables, section).check()


class _RecordCheck:
    def __init__(
        self,
        index: Index,
        report: FindingReport,
        variables: VariableNames,
        section: RecordSection,
    ) -> None:
        self._index = index
        self._report = report
        self._variables = variables
        self._section = section

    def check(self) -> None:
        """Report every invalid key of the section."""
        section = self._section
        if not section.folder and not section.to:
            self._add("folder", "it has no folder for its files", "a folder, or a store by 'to'")
        if section.to:
            self._check_store()
        every = self._parsed("every", parse_every, section.every) or Distance()
        times = RecordTimes(
            self._parsed("ring", parse_ring, section.ring) or 0,
            self._parsed("before", parse_ring, section.before) or 0,
            self._parsed("after", parse_time, section.after) or 0,
        )
        self._parsed("split", parse_split, section.split)
        has_files = bool(section.folder or section.split or section.keep)
        found = find_contradiction(
            section.kind, every, times, section.when, section.to, has_files=has_files
        )
        if found:
            key, reason = found
            self._add(key, f"{key}: {reason}", f"a recording without {key}, or without the other")
        self._check_patterns()
        if section.when:
            self._check_condition()

    def _add(self, key: str, message: str, expected: str) -> None:
        section = self._section
        self._report.add(f"{section.at}.{key}", f"recording {section.name}: {message}", expected)

    def _parsed(self, key: str, parse: Callable[[Any], Any], text: str | int) -> Any:
        if text == "":
            return None
        try:
            return parse(text)
        except ValueError as exc:
            what, _, expected = str(exc).partition(": expected ")
            self._add(key, f"{key}: {what}", expected)
            return None

    def _check_store(self) -> None:
        parts = urlsplit(self._section.to)
        if parts.scheme not in STORE_SCHEMES or not parts.hostname:
            schemes = ", ".join(f"{each}://…" for each in STORE_SCHEMES)
            self._add("to", f"to: {self._section.to!r} is no store", schemes)

    def _check_patterns(self) -> None:
        section = self._section
        known, thing, form = self._names(), "variable", _PATTERN
        if section.kind is RecordKind.FRAMES:
            known, thing, form = self._ports(), "port", _PORT_PATTERN
        stations = [each.name for each in self._index.plant.stations]
        for position, pattern in enumerate(section.patterns):
            if any(map(matcher([pattern]), known)) or self._variables.may_be_on_bus(pattern):
                continue
            key = "of" if isinstance(section.of, str) else f"of[{position}]"
            hint = suggest(pattern, [*known, *stations])
            self._add(key, f"{pattern}: it selects no {thing}{hint}", form)

    def _check_condition(self) -> None:
        try:
            condition = Condition(self._section.when)
        except ValueError as exc:
            what, _, expected = str(exc).partition("; expected ")
            self._add("when", what, expected)
            return
        for name in condition.names:
            station, _, counter = name.partition("/")
            if name in COUNTERS or (station in self._variables.known and counter in COUNTERS):
                continue
            if "/" in name:
                self._variables.find(f"{self._section.at}.when", name)
            else:
                self._add(
                    "when",
                    f"{name!r} is no counter{suggest(name, COUNTERS)}",
                    f"STATION/VARIABLE or {one_of(COUNTERS)}",
                )

    def _names(self) -> list[str]:
        found = list(self._variables.names)
        for station in self._index.plant.stations:
            found += [f"{station.name}/{pd.name}" for pd in station.publish]
            found += [f"{station.name}/{pd.name}" for pd in station.subscribe]
        return found

    def _ports(self) -> list[str]:
        return [
            f"{station.name}/{port.name}"
            for station in self._index.plant.stations
            for port in station.ports
        ]
