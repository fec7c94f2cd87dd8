"""Literal status documents, in the shape that docs/control.md promises."""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec.structs import asdict

from eap.live.findings import StatusReport, findings
from eap.live.status import MergedStatus

NOW_S = 1_795_000_000.0


def rx(name: str, **more: Any) -> dict[str, Any]:
    row = {
        "name": name,
        "port": "eap0",
        "received": 123_400,
        "lost": 0,
        "duplicated": 0,
        "reordered": 0,
        "late": 0,
        "timeouts": 0,
        "discarded": {},
        "quality": 0,
        "age_us": 4200,
        "jitter_us": {"p50": 55, "p99": 111, "max": 2222},
        "state": "running",
    }
    return row | more


def tx(name: str, **more: Any) -> dict[str, Any]:
    row = {"name": name, "port": "eap0", "sent": 9, "skipped": 0, "reason": {"cycle": 9}}
    return row | more


def document(*, tx: list[Any] = [], rx: list[Any] = [], **station: Any) -> dict[str, Any]:  # noqa: B006
    processes: dict[str, Any] = {
        "supervisor": {"pid": 100, "cpu": 0.0, "rss": 21_000_000},
        "engine": {"pid": 101, "cpu": 4.25, "rss": 35_400_000, "realtime": {}, "restarts": 0},
        "services": {"pid": 102, "cpu": None, "rss": None, "restarts": 0},
    }
    port = {
        "name": "eap0",
        "kind": "eap",
        "net_id": "5.1.1.1.2.1",
        "interface": "udp://127.0.1.1",
        "link": "up",
    }
    mixer = {
        "plant": "line",
        "name": "mixer",
        "net_id": "5.1.1.1.1.1",
        "state": "OP",
        "cycle_us": 10_000,
        "ports": [port],
        "discarded": {},
        "pd": {"tx": tx, "rx": rx},
    }
    stations = [mixer | station]
    appliance = {"plant": "line", "stations": ["mixer"], "processes": processes}
    return {
        "version": 1,
        "processes": processes,
        "stations": stations,
        "appliances": [appliance],
    }


def bus_port(name: str = "bus0", **more: Any) -> dict[str, Any]:
    slaves = [
        {"address": 1001, "name": "drive", "state": "OP", "target": "OP", "fault": ""},
        {"address": 1002, "name": "press", "state": None, "target": "OP", "fault": "is lost"},
    ]
    lost = {"what": "press (1002) is lost", "advice": "", "port": None, "is_over": False,
            "slaves": [{"address": 1002, "name": "press"}],
            "since": None, "until": None}  # fmt: skip
    bus = {"is_up": True, "fault": "", "findings": [lost], "slaves": slaves, "cycles": 12,
           "lost": 3, "wkc_errors": 0, "expected_wkc": 3, "received_wkc": 2,
           "trip_us": 480, "max_trip_us": 999}  # fmt: skip
    where = "sim:///plants/buses/line.yaml"
    port = {"name": name, "kind": "bus", "net_id": "5.1.1.1.3.1", "interface": where, "link": "up"}
    return port | {"bus": bus | more}


def frame(name: str, **more: Any) -> dict[str, Any]:
    row = {
        "name": name,
        "port": "eap0",
        "destination": "10.0.0.2",
        "address": "10.0.0.2",
        "sent": 90,
        "skipped": 0,
        "frame_state": 0,
        "monitor_interval_ms": None,
        "subscriber": "unknown",
    }
    return row | more


def merged(status: dict[str, Any]) -> MergedStatus:
    """Return *status* as the client has it."""
    return msgspec.convert(status, MergedStatus)


def with_findings(status: dict[str, Any]) -> StatusReport:
    """Return *status* with its findings."""
    found = merged(status)
    return StatusReport(**asdict(found), findings=findings(found, NOW_S))
