"""Findings about a bus from the report of its engine, and as JSON has them."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from devicebus.master.findings import (
    NO_ANSWER,
    BusFinding,
    History,
    SlaveView,
    Times,
    find_causes,
    find_silence,
)
from eap.appliance.bus_request import BusReport, SlaveReport


class NamedSlave(msgspec.Struct, frozen=True):
    """Slave that a finding is about."""

    address: int
    name: str


class FindingRow(msgspec.Struct, frozen=True, kw_only=True):
    """Finding about a bus as JSON has it; *since* and *until* are Unix times."""

    what: str
    advice: str
    slaves: list[NamedSlave]
    port: int | None
    is_over: bool
    since: float | None
    until: float | None


def report_findings(report: BusReport) -> list[BusFinding]:
    """Return what is wrong with a bus now."""
    views = [_view(slave) for slave in report.slaves]
    if is_silent(report):
        return [find_silence(views, report.silent_since_ns)]
    return find_causes(views)


def is_silent(report: BusReport) -> bool:
    """Whether no frame comes back, so that nothing is known about any slave."""
    return report.silent_since_ns is not None and report.silent_until_ns is None


def history_of(report: BusReport) -> History:
    """Return what a report says of the past."""
    over = []
    ports = {}
    silence = None
    if report.silent_since_ns is not None and report.silent_until_ns is not None:
        silence = Times(report.silent_since_ns, report.silent_until_ns)
    for slave in report.slaves:
        if slave.since_ns is not None and slave.until_ns is not None:
            view = SlaveView(slave.station, slave.name, trouble=slave.past_fault)
            over.append((view, Times(slave.since_ns, slave.until_ns)))
        for each in slave.port_errors:
            ports[slave.station, each.port] = Times(each.since_ns, each.until_ns)
    since_ns = report.silent_since_ns if is_silent(report) else None
    return History(tuple(over), silence, since_ns, ports)


def finding_row(finding: BusFinding, names: Mapping[int, str], now_s: float) -> FindingRow:
    """Return a finding as JSON has it.

    Args:
        finding: The finding.
        names: Of slaves, by station address.
        now_s: Unix time at which it was made.
    """
    return FindingRow(
        what=finding.what,
        advice=finding.advice,
        slaves=[NamedSlave(at, names[at]) for at in finding.slaves],
        port=finding.port,
        is_over=finding.is_over,
        since=_moment(finding.since_ns, now_s),
        until=_moment(finding.until_ns, now_s),
    )


def _view(slave: SlaveReport) -> SlaveView:
    answers = bool(slave.state) or slave.fault != NO_ANSWER
    since_ns = slave.since_ns if slave.fault else None
    return SlaveView(slave.station, slave.name, answers, slave.fault if answers else "", since_ns)


def _moment(ago_ns: int | None, now_s: float) -> float | None:
    return None if ago_ns is None else round(now_s - ago_ns / 1e9, 3)
