"""What ``status`` says of a bus port, from the report of the engine."""

from __future__ import annotations

from typing import Any

from devicebus.wire.alstatus import state_name
from eap.appliance.bus_findings import finding_row, report_findings
from eap.appliance.bus_request import BusReport


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
            "frames": {
                "sent": report.frames_sent,
                "received": report.frames_received,
                "late": report.frames_late,
                "lost": report.frames_lost,
                "retried": report.frames_retried,
                "timeout_us": report.timeout_ns // 1000,
                "round_trip_us": report.round_trip_ns // 1000,
            },
        }
    }
