"""Variables of a plant file: types, sources, links, and checks that each has one writer.

A link whose source is the target of another link runs after it, so that a value passes a chain of
links in one cycle.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import Boolean, DataType
from eap.codec.structures import complete, variable_of
from eap.config.exchange import is_unresolved
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index, VariablePart
from eap.config.ports import check_names
from eap.config.structs import LinkSection, StationSection, VariableSection
from eap.pd.rules import MADE_SUFFIXES
from eap.pd.spec import (
    INTERFACE_MEASURES,
    CounterSource,
    CsvSource,
    HostSource,
    Measure,
    RampSource,
    RandomSource,
    SineSource,
    Source,
)
from eap.suggest import suggest


def check_variables(index: Index, report: FindingReport, folder: Path) -> None:
    """Report invalid variables and sources that cannot fill them."""
    for station in index.plant.stations:
        own = {f"{station.at}.variables.{n}": (n, v) for n, v in station.variables.items()}
        received = {
            f"{subscription.at}.variables.{name}": (name, variable)
            for subscription in station.subscribe
            for name, variable in (subscription.variables or {}).items()
        }
        names = [(path, name) for path, (name, _) in (own | received).items()]
        names += [
            (subscription.at, name)
            for subscription in station.subscribe
            if subscription.variables is None
            for name in index.received(subscription)
        ]
        names += [
            (port.at, name)
            for port in station.ports
            if (bus := index.buses.get((station.name, port.name))) is not None
            for name in bus.variables
        ]
        check_names(names, "variable", report)
        for path, (name, variable) in (own | received).items():
            _check_variable(path, name, variable, report)
        for name, source in station.sources.items():
            if name.partition("[")[0] in index.bus_variables(station):
                message = f"{name!r} is on a bus, so it cannot have a source"
                expected = "a source for a variable of the station, and a link from that one"
                report.add(f"{station.at}.sources.{name}", message, expected)
            else:
                _check_source(index, station, name, source, report, folder)
        _check_shared_sources(index, station, report)


def _check_variable(path: str, name: str, variable: VariableSection, report: FindingReport) -> None:
    if name.endswith(MADE_SUFFIXES):
        message = f"variable {name!r}: {' and '.join(MADE_SUFFIXES)} are made by the appliance"
        report.add(path, message, "another name")
    try:
        kind = datatypes.parse(variable.type)
    except ValueError as exc:
        if variable.type not in report.broken_types:
            expected = "a data type such as UINT, REAL or BLOCK(64)"
            report.add(f"{path}.type", f"{name}: {exc}", expected)
        return
    if variable.default is None:
        return
    try:
        kind.from_plain(complete(kind, variable.default))
    except ValueError as exc:
        what, _, expected = str(exc).partition(": expected ")
        expected = expected or f"a value of {kind.name}"
        report.add(f"{path}.default", f"default of {name}: {what}", expected)


def _check_source(
    index: Index,
    station: StationSection,
    name: str,
    source: Source,
    report: FindingReport,
    folder: Path,
) -> None:
    path = f"{station.at}.sources.{name}"
    if variable_of(name, station.variables) not in station.variables:
        _report_no_variable(station, name, path, report)
        return
    period = getattr(source, "period_ms", 1)
    # msgspec checks no range here: the records of sources are shared with the engine.
    if period <= 0:
        report.add(f"{path}.period_ms", f"period_ms is {period:g}", "more than 0")
    kind = _kind(index, report, station, path, name)
    if kind is None:
        return
    match source:
        case HostSource():
            _check_number(path, name, kind, report)
            _check_measure(path, source, report)
        case CsvSource():
            _check_csv(path, kind, source, report, folder)
        case CounterSource() | RampSource() | SineSource():
            _check_number(path, name, kind, report)
            _check_span(path, kind, source, report)
        case RandomSource():
            if name not in station.variables:
                _check_random(path, name, kind, report)


def _report_no_variable(
    station: StationSection, name: str, path: str, report: FindingReport
) -> None:
    if name in report.broken:
        return
    known = station.variables
    received = {each for sub in station.subscribe for each in sub.variables or {}}
    if variable_of(name, received) in received:
        message = f"{name!r} is received, so it cannot have a source"
    else:
        message = f"station {station.name} has no variable {name!r}{suggest(name, known)}"
    report.add(path, message, one_of(known))


def _check_random(path: str, name: str, kind: DataType, report: FindingReport) -> None:
    # Random bytes are values of every other type; a bit field shares its byte with other members.
    if kind.is_bits:
        message = f"{name} is {kind.name}, this source makes whole bytes"
        report.add(path, message, "another member")


def _check_shared_sources(index: Index, station: StationSection, report: FindingReport) -> None:
    """Report sources that fill the same part of a variable, or one variable in two processes."""
    spans: dict[str, list[tuple[str, Span, bool]]] = {}
    for name, source in station.sources.items():
        try:
            part = index.part(station, name)
        except ValueError:
            continue  # reported with the source
        if part is None:
            continue
        span = Span(part.variable, part.bit_offset, part.kind.bit_length)
        by_services = isinstance(source, HostSource | CsvSource)
        others = spans.setdefault(part.variable, [])
        for other, theirs, is_theirs in others:
            line = report.line_of(f"{station.at}.sources.{other}")
            if theirs.overlaps(span):
                message = f"{name!r} has two sources (the other, {other!r}, in line {line})"
                report.add(f"{station.at}.sources.{name}", message, "one source for each part")
            elif is_theirs is not by_services:
                message = f"{part.variable!r} has sources of two kinds (also in line {line})"
                expected = "only host and csv sources, or none of them, within one variable"
                report.add(f"{station.at}.sources.{name}", message, expected)
        others.append((name, span, by_services))


def _check_number(path: str, name: str, kind: DataType, report: FindingReport) -> None:
    if kind.scalar_range is None or kind.is_bits:
        message = f"{name} is {kind.name}, this source makes numbers"
        report.add(path, message, "a number such as UDINT or REAL")


def _check_measure(path: str, source: HostSource, report: FindingReport) -> None:
    if source.measure in INTERFACE_MEASURES:
        if not source.argument:
            report.add(path, f"{source.measure} needs an argument", "argument: an interface as lo")
    elif source.argument and source.measure is not Measure.TEMPERATURE:
        report.add(f"{path}.argument", f"{source.measure} has no argument", "no argument")


def _check_span(
    path: str,
    kind: DataType,
    source: CounterSource | RampSource | SineSource,
    report: FindingReport,
) -> None:
    bounds = kind.scalar_range
    # A counter wraps with its type and cannot leave its range.
    if bounds is None or isinstance(source, CounterSource):
        return
    if isinstance(source, RampSource):
        low, high = min(source.low, source.high), max(source.low, source.high)
    else:
        low = source.offset - abs(source.amplitude)
        high = source.offset + abs(source.amplitude)
    if low < bounds[0] or high > bounds[1]:
        message = f"the source goes from {low:g} to {high:g}, beyond {kind.name}"
        report.add(path, message, f"{bounds[0]:g} to {bounds[1]:g}")


def _check_csv(
    path: str, kind: DataType, source: CsvSource, report: FindingReport, folder: Path
) -> None:
    try:
        with (folder / source.file).open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, strict=True)
            columns = rows.fieldnames or []
            if source.column not in columns:
                message = f"{source.file} has no column {source.column!r}"
                message += suggest(source.column, columns)
                report.add(f"{path}.column", message, one_of(columns))
                return
            # Every row is parsed: an error at run time could come hours after the start.
            count = 0
            for count, row in enumerate(rows, 1):  # noqa: B007  an empty file leaves 0
                kind.parse_text(row[source.column] or "")
    except (OSError, csv.Error, UnicodeDecodeError) as exc:
        reason = getattr(exc, "strerror", None) or exc
        report.add(f"{path}.file", f"{source.file}: {reason}", "a CSV file, from the plant file on")
        return
    except ValueError as exc:
        message = f"{source.file}, line {rows.line_num}: {exc}"
        report.add(f"{path}.column", message, f"values of {kind.name}")
        return
    if not count:
        report.add(f"{path}.file", f"{source.file} has no rows", "at least one row")


class Span(NamedTuple):
    """Consecutive bits of one variable."""

    variable: str
    start: int
    bits: int

    def overlaps(self, other: Span) -> bool:
        """Return whether both spans have a bit in common."""
        return (
            self.variable == other.variable
            and self.start < other.start + other.bits
            and other.start < self.start + self.bits
        )


class Ends(NamedTuple):
    """Source and target of a link, in bits."""

    source: Span
    target: Span


def is_bitwise(link: LinkSection) -> bool:
    """Return whether *link* selects the bits that it copies."""
    return any(each is not None for each in (link.from_bit, link.to_bit, link.bits))


def is_scaled(link: LinkSection) -> bool:
    """Return whether *link* computes its value."""
    return link.scale is not None or link.offset is not None


def ends(link: LinkSection, source: VariablePart, target: VariablePart) -> Ends:
    """Return the bits at both ends of *link*; without ``bits`` as many as both ends have."""
    if not is_bitwise(link):
        return Ends(
            Span(source.variable, source.bit_offset, source.kind.bit_length),
            Span(target.variable, target.bit_offset, target.kind.bit_length),
        )
    from_bit, to_bit = link.from_bit or 0, link.to_bit or 0
    bits = link.bits or min(source.kind.bit_length - from_bit, target.kind.bit_length - to_bit)
    return Ends(
        Span(source.variable, source.bit_offset + from_bit, bits),
        Span(target.variable, target.bit_offset + to_bit, bits),
    )


def execution_order(links: Sequence[Ends]) -> list[int]:
    """Return the positions of *links* in execution order, without those in and behind a loop.

    Links that do not depend on each other keep their order.
    """
    before = _predecessors(links)
    after = defaultdict(list)
    for position, others in enumerate(before):
        for other in others:
            after[other].append(position)
    missing = [len(others) for others in before]
    free = [position for position, number in enumerate(missing) if not number]
    # A heap, not a queue: links that are free to run keep the order of the file.
    heapify(free)
    order = []
    while free:
        order.append(heappop(free))
        for position in after[order[-1]]:
            missing[position] -= 1
            if not missing[position]:
                heappush(free, position)
    return order


def find_loops(links: Sequence[Ends]) -> list[list[int]]:
    """Return loops of *links* that have no link in common, each in the direction of its values."""
    before = _predecessors(links)
    left = set(range(len(links))) - set(execution_order(links))
    loops = []
    while left:
        loop = _walk_back(before, left)
        if loop:
            # From its first link in the file, so that the same loop has the same text each time.
            first = loop.index(min(loop))
            loops.append(loop[first:] + loop[:first])
    return loops


def _walk_back(before: Sequence[Sequence[int]], left: set[int]) -> list[int]:
    """Walk back to the first repeated link; remove the loop, or a link without one, from *left*."""
    path = [min(left)]
    while True:
        earlier = next((each for each in before[path[-1]] if each in left), None)
        if earlier is None:
            left.discard(path[-1])
            return []
        if earlier in path:
            loop = path[path.index(earlier) :][::-1]
            left.difference_update(loop)
            return loop
        path.append(earlier)


def _predecessors(links: Sequence[Ends]) -> list[list[int]]:
    writers = defaultdict(list)
    for position, link in enumerate(links):
        writers[link.target.variable].append(position)
    return [
        [
            position
            for position in writers[link.source.variable]
            # By bits: a link may fill one bit of a variable and another one read the next.
            if links[position].target.overlaps(link.source)
        ]
        for link in links
    ]


_TARGET = "a variable of the station's own, or an output of a bus"

_KEYS = ("from_bit", "to_bit", "bits", "scale", "offset", "swap")


def check_links(index: Index, report: FindingReport) -> None:
    """Report every link that cannot run, or that shares its target with another writer."""
    for station in index.plant.stations:
        known: list[tuple[LinkSection, Ends]] = []
        for link in station.links:
            source = _part(index, report, station, f"{link.at}.from", link.source)
            target = _part(index, report, station, f"{link.at}.to", link.target)
            if target is not None:
                _check_writer(index, report, station, link, target)
            if source is None or target is None:
                continue
            if not _fits(link, source.kind, target.kind, report):
                continue
            known.append((link, ends(link, source, target)))
        _check_duplicates(known, report)
        _check_loops(known, report)


def _kind(
    index: Index, report: FindingReport, station: StationSection, path: str, name: str
) -> DataType | None:
    """Return the type of a variable or a part of one; None, with a finding, if there is none."""
    part = _part(index, report, station, path, name)
    return None if part is None else part.kind


def _part(
    index: Index, report: FindingReport, station: StationSection, path: str, name: str
) -> VariablePart | None:
    """Return a variable or a part of one; None, with a finding, if there is none."""
    names = index.names(station)
    try:
        part = index.part(station, name)
    except ValueError as exc:
        variable = variable_of(name, names)
        if _has_type(index, station, variable):  # else reported with the variable
            report.add(path, f"station {station.name} has no {name!r}: {exc}", "a member of it")
        return None
    if part is None and not is_unresolved(index, report, station, name):
        hint = suggest(name, names) or suggest(re.split(r"[.[]", name)[0], names)
        message = f"station {station.name} has no variable {name!r}{hint}"
        report.add(path, message, one_of(names))
    return part


def _has_type(index: Index, station: StationSection, variable: str) -> bool:
    try:
        datatypes.parse(index.type_text(station, variable) or "")
    except ValueError:
        return False
    return True


def _check_writer(
    index: Index,
    report: FindingReport,
    station: StationSection,
    link: LinkSection,
    target: VariablePart,
) -> None:
    name = target.variable
    on_bus = index.bus_variables(station).get(name)
    if name in station.variables:
        source = _source_beside(index, station, link, target)
        if not source:
            return
        line = report.line_of(f"{station.at}.sources.{source}")
        reason = f"has a source (line {line})"
    elif on_bus is None:
        reason = "is received"
    elif on_bus.is_output:
        return
    else:
        reason = "comes from a bus"
    report.add(f"{link.at}.to", f"{link.target!r} {reason}, so no link can write it", _TARGET)


def _source_beside(
    index: Index, station: StationSection, link: LinkSection, target: VariablePart
) -> str:
    """Return a source that fills what *link* writes, or its variable from another process."""
    for name, source in station.sources.items():
        try:
            part = index.part(station, name)
        except ValueError:
            continue
        if part is None or part.variable != target.variable:
            continue
        span = Span(part.variable, part.bit_offset, part.kind.bit_length)
        both = ends(link, target, target)
        if isinstance(source, HostSource | CsvSource) or span.overlaps(both.target):
            return name
    return ""


def _fits(link: LinkSection, source: DataType, target: DataType, report: FindingReport) -> bool:
    """Return whether a link can connect these types, after reporting the reason if not."""
    if any(report.has(f"{link.at}.{key}") for key in _KEYS):
        return False
    if is_bitwise(link):
        return _fits_bitwise(link, source, target, report)
    shown = f"{link.source} is {source.name}, {link.target} is {target.name}"
    if is_scaled(link):
        return _fits_scaled(link, source, target, shown, report)
    return _fits_whole(link, source, target, shown, report)


def _fits_whole(
    link: LinkSection, source: DataType, target: DataType, shown: str, report: FindingReport
) -> bool:
    if link.swap:
        if source.size == target.size > 1 and not (source.is_bits or target.is_bits):
            return True
        report.add(f"{link.at}.swap", shown, "two variables of the same size, at least 2 bytes")
        return False
    if source.wire != target.wire and not (_is_bool(source) and _is_bool(target)):
        expected = (
            f"both alike, or bits: {min(source.bit_length, target.bit_length)}, scale or swap"
        )
        report.add(link.at, shown, expected)
        return False
    return True


def _fits_bitwise(
    link: LinkSection, source: DataType, target: DataType, report: FindingReport
) -> bool:
    for key in ("scale", "offset", "swap"):
        if getattr(link, key):
            report.add(
                f"{link.at}.{key}", f"the link copies bits and has a {key}", "one of the two"
            )
            return False
    for key, bit, name, kind in (
        ("from_bit", link.from_bit or 0, link.source, source),
        ("to_bit", link.to_bit or 0, link.target, target),
    ):
        if bit >= kind.bit_length:
            message = f"{name} is {kind.name} and has no bit {bit}"
            report.add(f"{link.at}.{key}", message, f"0 to {kind.bit_length - 1}")
            return False
        if link.bits is not None and bit + link.bits > kind.bit_length:
            message = f"{name} is {kind.name} and has no {link.bits} bits from bit {bit} on"
            report.add(f"{link.at}.bits", message, f"at most {kind.bit_length - bit}")
            return False
    return True


def _fits_scaled(
    link: LinkSection, source: DataType, target: DataType, shown: str, report: FindingReport
) -> bool:
    key = "scale" if link.scale is not None else "offset"
    # It would make a constant, which a default does better.
    if link.scale == 0:
        report.add(f"{link.at}.scale", "scale is 0", "another number")
        return False
    if not (_is_number(source) and _is_number(target)):
        report.add(f"{link.at}.{key}", shown, f"numbers such as INT or REAL where there is a {key}")
        return False
    if link.swap and source.size < 2:
        report.add(f"{link.at}.swap", shown, "a source of at least 2 bytes")
        return False
    is_plain = link.scale in {None, 1} and not link.offset
    if link.swap and is_plain and source != target and source.size == target.size:
        # The engine does not distinguish it from a swap alone, which converts nothing.
        message = f"{shown}: a swap with {key} {getattr(link, key):g} computes nothing"
        report.add(f"{link.at}.{key}", message, "swap alone to copy the bytes, or another number")
        return False
    return True


def _is_number(kind: DataType) -> bool:
    # BOOL has a range from 0 to 1, but a scaled BOOL is an error of the file.
    return kind.scalar_range is not None and not _is_bool(kind)


def _is_bool(kind: DataType) -> bool:
    """Return whether *kind* is a BOOL; that of a struct has a byte, another one a bit."""
    return isinstance(kind, Boolean)


def _check_duplicates(links: list[tuple[LinkSection, Ends]], report: FindingReport) -> None:
    first: dict[str, list[tuple[LinkSection, Ends]]] = {}
    for link, both in links:
        others = first.setdefault(both.target.variable, [])
        twice = next((other for other, span in others if span.target.overlaps(both.target)), None)
        others.append((link, both))
        if twice is not None:
            line = report.line_of(f"{twice.at}.to")
            message = f"{link.target!r} is linked twice (first in line {line})"
            report.add(
                f"{link.at}.to", message, "one link for each variable, or for each bit of it"
            )


def _check_loops(links: list[tuple[LinkSection, Ends]], report: FindingReport) -> None:
    for loop in find_loops([both for _, both in links]):
        members = [links[position][0] for position in loop]
        path = " → ".join([members[0].source, *(link.target for link in members)])
        report.add(members[0].at, f"links form a loop: {path}", "one of them to be left out")
