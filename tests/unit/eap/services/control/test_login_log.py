"""Refused logins in status and audit."""

from __future__ import annotations

import json
from pathlib import Path

from eap.ams.directory import Directory
from eap.runtime.logins import LoginFailure, LoginRefusals
from eap.services.control.audit import Audit, AuditFile
from eap.services.control.login_log import ROUTE_LOGINS, LoginLog

WRONG = LoginRefusals("anna", "10.0.0.9", LoginFailure.WRONG, 3)
LOCKED = LoginRefusals("anna", "10.0.0.9", LoginFailure.LOCKED, 2)


def test_refused_logins_are_counted_audited_and_a_warning_for_a_while(tmp_path: Path) -> None:
    now = [1000.0]
    audit = Audit(AuditFile(tmp_path / "audit.jsonl"), Directory(()), now=lambda: now[0])
    log = LoginLog("cell", audit, now=lambda: now[0])
    assert (log.report(), log.findings()) == ({}, [])
    log.note("web", [WRONG, LOCKED])
    log.note(ROUTE_LOGINS, [WRONG])
    assert log.report() == {
        "web": {"wrong": 3, "locked": 2, "busy": 0},
        "ams-udp": {"wrong": 3, "locked": 0, "busy": 0},
    }
    web, routes = log.findings()
    assert (web["where"], routes["where"]) == ("cell web", "cell ams-udp")
    assert web["what"] == "5 logins refused, 2 of them locked out; last 'anna' from 10.0.0.9"
    # A request for a route has its line with the result.
    lines = [json.loads(line) for line in audit.path.read_text().splitlines()]
    assert [(each["transport"], each["from"], each["user"], each["count"]) for each in lines] == [
        ("web", "10.0.0.9", "anna", 3),
        ("web", "10.0.0.9", "anna", 2),
    ]
    now[0] += 1000
    assert log.findings() == []
