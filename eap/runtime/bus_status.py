"""Status of a bus from the report of its engine: findings, frames, and the key of ``status``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import msgspec

from devicebus.master.emergencies import describe_code
from devicebus.master.findings import (
    NO_ANSWER,
    BusFinding,
    FaultPeriod,
    History,
    MailboxTimeouts,
    RingCut,
    SlaveView,
    find_causes,
    find_ring_cut,
    find_silence,
    find_unanswered,
)
from devicebus.master.link import LinkStats
from devicebus.wire.alstatus import state_name
from eap.runtime.engine_messages import (
    BusReport,
    EmergencyReport,
    EoeReport,
    LockState,
    SlaveReport,
)

_LOCK_FAULT_NS = 10_000_000_000
"""Frames that missed their time are a present fault for so long."""


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


class EmergencyRow(msgspec.Struct, frozen=True, kw_only=True):
    """Emergency of a slave as JSON has it; *time* is a Unix time."""

    time: float | None
    protocol: str
    drive: int
    code: int
    text: str
    """Class of the code."""
    register: int
    data: str


class FrameCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Frames of a master, and the round trip that it measures."""

    sent: int
    received: int
    late: int
    """Came back after their time-out."""
    lost: int
    """Never came back."""
    retried: int
    """Sent again."""
    timeout_us: int
    """Time-out of the next frame."""
    round_trip_us: int
    """Mean of the latest, 0 before the first."""


def count_frames(source: BusReport | LinkStats) -> FrameCounts:
    """Return the frames of a running bus, or those of a master of one's own."""
    prefix = "frames_" if isinstance(source, BusReport) else ""
    names = ("sent", "received", "late", "lost", "retried")
    return FrameCounts(
        **{name: getattr(source, prefix + name) for name in names},
        timeout_us=source.timeout_ns // 1000,
        round_trip_us=source.round_trip_ns // 1000,
    )


def report_findings(report: BusReport) -> list[BusFinding]:
    """Return the causes of the present faults of a bus, and its mailbox time-outs."""
    views = [_view(slave) for slave in report.slaves if not slave.is_absent]
    if is_silent(report):
        return [find_silence(views, report.silent_since_ns)]
    cut = [each for each in find_ring_cut(views, _ring_cut(report)) if not each.is_over]
    return [
        *cut,
        *find_causes(views),
        *find_unanswered(_mailboxes(report)),
        *find_emergencies(report.slaves),
        *find_lock_faults(report.lock),
        *find_eoe_faults(report.eoe),
    ]


def find_lock_faults(lock: LockState | None) -> Iterator[BusFinding]:
    """Yield that frames miss the time before SYNC0, or that there is no clock to follow."""
    if lock is None:
        return
    if lock.reference is None:
        yield BusFinding(
            what="the cycle runs free: no slave with a distributed clock answers",
            advice="check the first slave with a clock",
        )
    elif lock.fault_ns is not None and lock.fault_ns < _LOCK_FAULT_NS:
        yield BusFinding(
            what=(
                f"frames miss their time before SYNC0: {lock.late} too late, {lock.early} too early"
                f" (more than {lock.lead_ns // 2000} µs), last"
                f" {lock.fault_ns // 1_000_000_000} s ago"
            ),
            advice="see the lateness of the cycle in status, or raise sync_lead_us",
            until_ns=lock.fault_ns,
        )


def find_emergencies(slaves: Iterable[SlaveReport]) -> Iterator[BusFinding]:
    """Yield the errors that slaves have reported by emergencies and not taken back."""
    for slave in slaves:
        last = {(each.protocol, each.drive): each for each in slave.latest_emergencies}
        for each in last.values():
            if each.code:
                yield BusFinding(
                    what=f"{slave.name} ({slave.station}) reports emergency {_describe(each)}",
                    advice="read its error objects, see the manual of the device",
                    slaves=(slave.station,),
                    since_ns=each.ago_ns,
                )


def _describe(emergency: EmergencyReport) -> str:
    drive = f" of drive {emergency.drive}" if emergency.drive else ""
    return (
        f"0x{emergency.code:04X} by {emergency.protocol}{drive}: {describe_code(emergency.code)},"
        f" error register 0x{emergency.register:02X}"
    )


def emergency_rows(slave: SlaveReport, now_s: float) -> list[EmergencyRow]:
    """Return the latest emergencies of a slave at *now_s* (Unix time), oldest first."""
    return [
        EmergencyRow(
            time=_moment(each.ago_ns, now_s),
            protocol=each.protocol,
            drive=each.drive,
            code=each.code,
            text=describe_code(each.code),
            register=each.register,
            data=each.data,
        )
        for each in slave.latest_emergencies
    ]


def find_eoe_faults(report: EoeReport | None) -> Iterator[BusFinding]:
    """Yield what keeps Ethernet frames from the host or from slaves."""
    if report is None:
        return
    if report.fault:
        yield BusFinding(what=f"EoE: {report.fault}")
    for each in report.slaves:
        if each.fault:
            what = f"slave {each.station} ({each.name}): EoE: {each.fault}"
            yield BusFinding(what=what, slaves=(each.station,))


def is_silent(report: BusReport) -> bool:
    """Return whether no frame comes back, so that nothing is known about any slave."""
    return report.silent_since_ns is not None and report.silent_until_ns is None


def history_of(report: BusReport) -> History:
    """Return the faults of a report that are over."""
    over = []
    ports = {}
    silence = None
    if report.silent_since_ns is not None and report.silent_until_ns is not None:
        silence = FaultPeriod(report.silent_since_ns, report.silent_until_ns)
    for slave in report.slaves:
        if slave.since_ns is not None and slave.until_ns is not None:
            view = SlaveView(slave.station, slave.name, trouble=slave.past_fault)
            over.append((view, FaultPeriod(slave.since_ns, slave.until_ns)))
        for each in slave.port_errors:
            ports[slave.station, each.port] = FaultPeriod(each.since_ns, each.until_ns)
    since_ns = report.silent_since_ns if is_silent(report) else None
    return History(tuple(over), silence, since_ns, ports, _mailboxes(report), _ring_cut(report))


def _ring_cut(report: BusReport) -> RingCut | None:
    ring = report.ring
    if ring is None or ring.cut_ns is None:
        return None
    return RingCut(ring.ends, ring.cut_ns, ring.mended_ns)


def _mailboxes(report: BusReport) -> tuple[MailboxTimeouts, ...]:
    return tuple(
        MailboxTimeouts(
            SlaveView(each.station, each.name),
            each.mailbox_timeouts,
            each.mailbox_late,
            each.mailbox_timeout_ns,
        )
        for each in report.slaves
        if each.mailbox_timeout_ns is not None
    )


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


def bus_link(report: BusReport | None) -> str:
    """Return ``up`` when frames come back from slaves, else ``down``; None is no report."""
    if report is None or not report.is_up:
        return "down"
    return "up" if not report.slaves or any(slave.state for slave in report.slaves) else "down"


def bus_document(report: BusReport | None, now_s: float) -> dict[str, Any]:
    """Return the key ``bus`` of a port at *now_s* (Unix time), or nothing without a report."""
    if report is None:
        return {}
    names = {slave.station: slave.name for slave in report.slaves}
    found = report_findings(report) if report.is_up else []
    return {
        "bus": {
            "is_up": report.is_up,
            "fault": report.fault,
            "findings": [finding_row(each, names, now_s) for each in found],
            "slaves": [
                {
                    "address": slave.station,
                    "name": slave.name,
                    "state": state_name(slave.state) if slave.state else None,
                    "target": state_name(slave.target) if slave.target else None,
                    "fault": slave.fault,
                    "is_absent": slave.is_absent,
                    "emergencies": slave.emergencies,
                    "last_emergency": next(reversed(emergency_rows(slave, now_s)), None),
                }
                for slave in report.slaves
            ],
            "cycles": report.cycles,
            "wkc_errors": report.wkc_errors,
            "late": report.cycles_late,
            "lost": report.cycles_lost,
            "skipped": report.cycles_skipped,
            "expected_wkc": report.expected_wkc,
            "received_wkc": report.received_wkc,
            "trip_us": report.trip_ns // 1000,
            "max_trip_us": report.max_trip_ns // 1000,
            "frames": count_frames(report),
            **_ring_document(report, now_s),
            **({} if report.lock is None else {"lock": report.lock}),
            **({} if report.eoe is None else {"eoe": report.eoe}),
        }
    }


def _ring_document(report: BusReport, now_s: float) -> dict[str, Any]:
    """Return the key ``ring``, of a bus with two lines only."""
    ring = report.ring
    if ring is None:
        return {}
    names = {each.station: each.name for each in report.slaves}
    ends = [
        NamedSlave(each, names[each]) if each is not None and each in names else None
        for each in ring.ends or ()
    ]
    return {
        "ring": {
            "is_whole": ring.is_whole,
            "cuts": ring.cuts,
            "between": ends,
            "silent_lines": ring.silent,
            "cut": _moment(ring.cut_ns, now_s),
            "mended": _moment(ring.mended_ns, now_s),
        }
    }


def _view(slave: SlaveReport) -> SlaveView:
    answers = bool(slave.state) or slave.fault != NO_ANSWER
    since_ns = slave.since_ns if slave.fault else None
    return SlaveView(slave.station, slave.name, answers, slave.fault if answers else "", since_ns)


def _moment(ago_ns: int | None, now_s: float) -> float | None:
    return None if ago_ns is None else round(now_s - ago_ns / 1e9, 3)
