"""Variables of a plant file: their types and sources, and checks that each has one writer."""

from __future__ import annotations

import csv
import re
from contextlib import suppress
from pathlib import Path

from eap.codec import datatypes
from eap.codec.datatypes import DataType, find_part, split_paths, variable_of
from eap.codec.structures import complete
from eap.config.exchange import is_unresolved
from eap.config.finding import FindingReport, one_beside, one_of
from eap.config.index import Index, Span, VariablePart
from eap.config.ports import check_names
from eap.config.structs import StationSection, VariableSection
from eap.config.types import A_TYPE
from eap.pd.rules import MADE_SUFFIXES
from eap.pd.spec import (
    INTERFACE_MEASURES,
    CounterSource,
    CsvSource,
    HostSource,
    Measure,
    RampSource,
    RandomSource,
    ServicesSource,
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
        names += [(station.at, name) for name in index.field_variables(station)]
        names += [
            (port.at, name)
            for port in station.ports
            if (bus := index.buses.get((station.name, port.name))) is not None
            for name in bus.variables
        ]
        check_names(names, "variable", report)
        for path, name in names:
            _check_hidden_member(index, station, path, name, report)
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


def _check_hidden_member(
    index: Index, station: StationSection, path: str, name: str, report: FindingReport
) -> None:
    """Report a variable whose name is also the path of a member, which nothing could reach."""
    for variable, part in split_paths(name):
        with suppress(ValueError):  # no such variable, a wrong type, or no such member
            find_part(datatypes.parse(index.type_text(station, variable) or ""), part)
            message = f"variable {name!r} has the name of a member of {variable!r}"
            report.add(path, message, "another name")


def _check_variable(path: str, name: str, variable: VariableSection, report: FindingReport) -> None:
    if name.endswith(MADE_SUFFIXES):
        message = f"variable {name!r}: {' and '.join(MADE_SUFFIXES)} are made by the appliance"
        report.add(path, message, "another name")
    try:
        kind = datatypes.parse(variable.type)
    except ValueError as exc:
        if variable.type not in report.broken_types:
            report.add_error(f"{path}.type", name, exc, A_TYPE)
        return
    if variable.default is None:
        return
    try:
        kind.from_plain(complete(kind, variable.default))
    except ValueError as exc:
        report.add_error(f"{path}.default", f"default of {name}", exc, f"a value of {kind.name}")


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
    report.add(path, message, one_beside(name, known))


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
        span = part.span
        by_services = isinstance(source, ServicesSource)
        others = spans.setdefault(part.variable, [])
        for other, theirs, is_theirs in others:
            line = report.line_of(f"{station.at}.sources.{other}")
            if theirs.overlaps(span):
                message = f"{name!r} has two sources (the other, {other!r}, in line {line})"
                report.add(f"{station.at}.sources.{name}", message, "one source for each part")
            elif is_theirs is not by_services:
                message = f"{part.variable!r} has sources of two kinds (also in line {line})"
                expected = "only host, csv, s7 and modbus sources, or none, within one variable"
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


def _kind(
    index: Index, report: FindingReport, station: StationSection, path: str, name: str
) -> DataType | None:
    """Return the type of a variable or a part of one; None, with a finding, if there is none."""
    part = named_part(index, report, station, path, name)
    return None if part is None else part.kind


def named_part(
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
        report.add(path, message, one_beside(name, names))
    return part


def _has_type(index: Index, station: StationSection, variable: str) -> bool:
    try:
        datatypes.parse(index.type_text(station, variable) or "")
    except ValueError:
        return False
    return True
