"""Checks of variables and their sources: types, default values, and one writer each."""

from __future__ import annotations

import csv
from pathlib import Path

from eap.codec import datatypes
from eap.codec.values import DataType
from eap.config.check_ports import check_names
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index
from eap.config.structs import StationSection, VariableSection
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
    """Report variables that cannot exist and sources that cannot fill them."""
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
            if name in index.bus_variables(station):
                message = f"{name!r} is on a bus, so it cannot have a source"
                expected = "a source for a variable of the station, and a link from that one"
                report.add(f"{station.at}.sources.{name}", message, expected)
            else:
                _check_source(station, name, source, report, folder)


def _check_variable(path: str, name: str, variable: VariableSection, report: FindingReport) -> None:
    if name.endswith(MADE_SUFFIXES):
        message = f"variable {name!r}: {' and '.join(MADE_SUFFIXES)} are made by the appliance"
        report.add(path, message, "another name")
    try:
        kind = datatypes.parse(variable.type)
    except ValueError as exc:
        report.add(f"{path}.type", f"{name}: {exc}", "a data type such as UINT, REAL or BLOCK(64)")
        return
    if variable.default is None:
        return
    try:
        kind.from_plain(variable.default)
    except ValueError as exc:
        what, _, expected = str(exc).partition(": expected ")
        expected = expected or f"a value of {kind.text}"
        report.add(f"{path}.default", f"default of {name}: {what}", expected)


def _check_source(
    station: StationSection, name: str, source: Source, report: FindingReport, folder: Path
) -> None:
    path = f"{station.at}.sources.{name}"
    if name not in station.variables:
        if name not in report.broken:
            known = station.variables
            if any(name in (each.variables or {}) for each in station.subscribe):
                message = f"{name!r} is received, so it cannot have a source"
            else:
                message = f"{name!r} is no variable of {station.name}{suggest(name, known)}"
            report.add(path, message, one_of(known))
        return
    period = getattr(source, "period_ms", 1)
    if period <= 0:
        report.add(f"{path}.period_ms", f"period_ms is {period:g}", "more than 0")
    try:
        kind = datatypes.parse(station.variables[name].type)
    except ValueError:
        return  # reported with the variable
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
            pass  # random octets are values of every type


def _check_number(path: str, name: str, kind: DataType, report: FindingReport) -> None:
    if kind.scalar_range is None or kind.is_bits:
        message = f"{name} is {kind.text}, this source makes numbers"
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
    if bounds is None or isinstance(source, CounterSource):
        return
    if isinstance(source, RampSource):
        low, high = min(source.low, source.high), max(source.low, source.high)
    else:
        low = source.offset - abs(source.amplitude)
        high = source.offset + abs(source.amplitude)
    if low < bounds[0] or high > bounds[1]:
        message = f"the source goes from {low:g} to {high:g}, beyond {kind.text}"
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
            count = 0
            for count, row in enumerate(rows, 1):  # noqa: B007  an empty file leaves 0
                kind.parse_text(row[source.column] or "")
    except (OSError, csv.Error, UnicodeDecodeError) as exc:
        reason = getattr(exc, "strerror", None) or exc
        report.add(f"{path}.file", f"{source.file}: {reason}", "a CSV file, from the plant file on")
        return
    except ValueError as exc:
        message = f"{source.file}, line {rows.line_num}: {exc}"
        report.add(f"{path}.column", message, f"values of {kind.text}")
        return
    if not count:
        report.add(f"{path}.file", f"{source.file} has no rows", "at least one row")
