from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from eap.ads.request import Operation, ReadWrite, Write, WriteControl
from eap.ams.access import AddRoute, AuditedOperation, AuditEntry, Decision
from eap.ams.directory import Directory
from eap.ams.spec import AccessService, DirectoryPort, DirectoryStation
from eap.codec.ads import IndexGroup
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, InterfaceUri, NetId
from eap.services.control import audit as module
from eap.services.control.audit import BURST, KEPT, Audit, AuditFile
from tests.support.virtualtime import run_virtual

LAPTOP = Endpoint("ams-tcp", "10.0.0.5:49152")
HEADER = AmsHeader(
    NetId.parse("5.1.1.1.3.1"), 1001, NetId.parse("192.168.0.9.1.1"), 30000, 3, 4, invoke_id=1
)
NAMES = Directory(
    [
        DirectoryStation(
            "island-01",
            NetId.parse("5.1.1.1.1.1"),
            (
                DirectoryPort(
                    "bus0",
                    True,
                    NetId.parse("5.1.1.1.3.1"),
                    InterfaceUri.parse("sim://x"),
                    {"drive": 1001},
                ),
            ),
        )
    ]
)
WRITE = Write(IndexGroup.SDO, 0x8000_0001, b"\1\2\3\4")
ALLOWED = Decision(AccessService.WRITE, True, "rule drives allows it")


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def audit(tmp_path: Path, clock: Clock) -> Audit:
    path = tmp_path / "plant" / "audit.jsonl"
    return Audit(AuditFile(path), NAMES, clock=clock, now=lambda: 1_700_000_000.25)


def entry(
    operation: Operation | AddRoute = WRITE,
    result: int | None = 0,
    *,
    decision: Decision = ALLOWED,
    count: int = 1,
    endpoint: Endpoint = LAPTOP,
) -> AuditEntry:
    return AuditEntry(
        endpoint, HEADER, "", (AuditedOperation(operation, decision, result),) * count
    )


def lines(audit: Audit) -> list[dict[str, Any]]:
    return [json.loads(line) for line in audit.path.read_text().splitlines()]


def test_clients_of_the_control_socket_have_lines_and_limits(audit: Audit, clock: Clock) -> None:
    fields = {"operation": "od_write", "error": ""}
    for _ in range(BURST + 2):
        audit.write_request("uid 0, pid 7", "island-01", fields)
    audit.write_request("uid 0, pid 8", "island-01", fields)
    clock.now += 1
    audit.write_skipped()
    told = lines(audit)
    head = {"time": "2023-11-14T22:13:20.250+00:00", "station": "island-01", "transport": "control"}
    assert told[0] == head | {"from": "uid 0, pid 7"} | fields
    assert [each["from"] for each in told].count("uid 0, pid 7") == BURST + 1
    assert told[-2] == told[0] | {"from": "uid 0, pid 8"}
    assert told[-1] == head | {"from": "uid 0, pid 7", "skipped": 2}


def test_audit_line_has_client_operation_and_result(audit: Audit) -> None:
    audit.write("island-01", entry(result=0x706))
    assert lines(audit) == [
        {
            "time": "2023-11-14T22:13:20.250+00:00",
            "station": "island-01",
            "transport": "ams-tcp",
            "from": "10.0.0.5:49152",
            "source": "192.168.0.9.1.1:30000",
            "target": "5.1.1.1.3.1:1001",
            "name": "island-01/bus0/drive",
            "route": "",
            "operation": "Write",
            "group": "0xF302",
            "offset": "0x80000001",
            "object": "0x8000:01",
            "length": 4,
            "value": "01020304",
            "service": "write",
            "allowed": True,
            "why": "rule drives allows it",
            "result": 0x706,
            "error": "error 0x706 (VALUE)",
        }
    ]


@pytest.mark.parametrize(
    ("operation", "said"),
    [
        (WriteControl(5, 8, b""), {"states": [5, 8], "length": 0, "value": ""}),
        (
            Write(IndexGroup.SDO, 0x8000_0100, bytes(9)),
            {"object": "0x8000:00 (complete access)", "length": 9, "sha256": "3e7077fd2f66d689"},
        ),
        (
            AddRoute("tool", "10.0.0.5.1.1", "10.0.0.5", "maria"),
            {
                "operation": "AddRoute",
                "adds": {
                    "name": "tool",
                    "net_id": "10.0.0.5.1.1",
                    "address": "10.0.0.5",
                    "user": "maria",
                },
            },
        ),
        (ReadWrite(IndexGroup.FOE_OPEN_WRITE, 0, 4, b"a.bin\0"), {"file": "a.bin", "length": 6}),
    ],
)
def test_audit_has_the_fields_of_an_operation(
    audit: Audit, operation: Operation | AddRoute, said: dict[str, Any]
) -> None:
    audit.write("island-01", entry(operation))
    (line,) = lines(audit)
    assert line | said == line


def test_audit_has_the_reason_of_a_refusal(audit: Audit) -> None:
    denied = Decision(AccessService.WRITE, False, "no rule allows it, and other hosts only read")
    audit.write("island-01", entry(result=0x723, decision=denied))
    (line,) = lines(audit)
    assert not line["allowed"]
    assert line["error"] == "error 0x723 (access rules forbid it)"


def test_audit_counts_a_flood_and_writes_other_clients(audit: Audit, clock: Clock) -> None:
    audit.write("island-01", entry(count=BURST + 20))
    audit.write("island-01", entry(endpoint=Endpoint("ams-tcp", "10.0.0.6:1")))
    assert len(lines(audit)) == BURST + 1
    audit.write_skipped()
    audit.write_skipped()
    assert lines(audit)[BURST + 1 :] == [
        {
            "time": "2023-11-14T22:13:20.250+00:00",
            "station": "island-01",
            "transport": "ams-tcp",
            "from": "10.0.0.5",
            "skipped": 20,
        }
    ]
    clock.now += 1
    audit.write("island-01", entry(count=BURST))
    assert len(lines(audit)) == BURST + 2 + BURST // 10


def test_audit_bounds_a_flood_by_transport(audit: Audit) -> None:
    for number in range(12):
        endpoint = Endpoint("udp:eap0", f"10.0.0.{number}:34980")
        audit.write("island-01", entry(endpoint=endpoint, count=BURST))
    audit.write("island-01", entry())
    # The first line of each client counts among those of new ones.
    assert len(lines(audit)) == module.TRANSPORT_RATE.burst + 12 + 1


def test_flood_from_invented_addresses_leaves_known_clients_their_lines(audit: Audit) -> None:
    known = Endpoint("udp:eap0", "10.0.0.5:34980")
    audit.write("island-01", entry(endpoint=known))
    for number in range(module.NEW_RATE.burst + 10):
        endpoint = Endpoint("udp:eap0", f"10.1.{number >> 8}.{number & 255}:34980")
        audit.write("island-01", entry(endpoint=endpoint))
    audit.write("island-01", entry(endpoint=known))
    found = [line["from"] for line in lines(audit)]
    assert found.count(known.connection) == 2
    assert len(found) == module.NEW_RATE.burst + 1, "one of the new ones is the known client"


def test_audit_forgets_addresses_but_not_skipped_lines(audit: Audit) -> None:
    audit.write("island-01", entry(count=BURST + 1))
    for number in range(1100):
        endpoint = Endpoint("ams-tcp", f"10.1.{number // 250}.{number % 250}:1")
        audit.write("island-01", entry(endpoint=endpoint))
    audit.write_skipped()
    skipped = {line["from"]: line["skipped"] for line in lines(audit) if "skipped" in line}
    assert skipped["10.0.0.5"] == 1
    assert len(lines(audit)) - len(skipped) == BURST + module.NEW_RATE.burst - 1
    assert sum(skipped.values()) == 1 + 1100 - (module.NEW_RATE.burst - 1)


def test_old_files_go(audit: Audit, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 1000)
    for number in range(20):
        audit.write(f"island-{number}", entry())
    names = sorted(path.name for path in audit.path.parent.iterdir())
    older = [f"audit.jsonl.{number}" for number in range(1, KEPT + 1)]
    assert [name for name in names if name != "audit.jsonl"] == older
    kept = [json.loads(audit.path.with_name(name).read_text().splitlines()[0]) for name in older]
    numbers = [int(line["station"].partition("-")[2]) for line in kept]
    assert numbers == sorted(numbers, reverse=True)


class FullDisk(AuditFile):
    """A file on a disk that takes nothing until *error* is cleared."""

    error = "No space left on device"

    def append(self, lines: bytes) -> None:
        if self.error:
            raise OSError(28, self.error)
        super().append(lines)


def test_audit_counts_lost_lines_and_reports_them_later(
    tmp_path: Path, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    file = FullDisk(tmp_path / "plant" / "audit.jsonl")
    audit = Audit(file, NAMES, clock=clock, now=lambda: 1_700_000_000.0 + clock.now)
    audit.write("island-01", entry(count=2))
    clock.now += 5
    audit.write("island-01", entry())
    times = "2023-11-14T22:15:00.000+00:00", "2023-11-14T22:15:05.000+00:00"
    unix = 1_700_000_100.0, 1_700_000_105.0
    assert audit.lost == (3, *unix, "No space left on device")
    audit.write_lost()
    assert audit.lost.lines == 3
    file.error = ""
    clock.now += 5
    audit.write_lost()
    assert audit.lost == (3, *unix, "")
    audit.write("island-01", entry())
    first, second = lines(audit)
    assert first == {
        "time": "2023-11-14T22:15:10.000+00:00", "lost": 3, "since": times[0], "until": times[1],
        "error": "No space left on device",
    }  # fmt: skip
    assert second["operation"] == "Write"
    assert caplog.messages == [
        f"audit {file.path}: changes are not recorded: No space left on device",
        f"audit {file.path}: written again; 3 lines are lost",
    ]


def required(file: AuditFile, clock: Clock) -> Audit:
    return Audit(file, NAMES, is_required=True, clock=clock, now=lambda: 1_700_000_000.0)


def test_required_audit_has_a_line_before_and_after_each_change(
    tmp_path: Path, clock: Clock
) -> None:
    audit = required(AuditFile(tmp_path / "audit.jsonl"), clock)
    assert audit.begin("island-01", entry(result=None)) == ""
    audit.write("island-01", entry())
    assert audit.begin_request("uid 0, pid 7", "island-01", {"operation": "od_write"}) == ""
    audit.write_request("uid 0, pid 7", "island-01", {"operation": "od_write", "error": ""})
    first, second, third, last = lines(audit)
    assert first["begins"]
    assert first | {"result": 0, "error": ""} == second | {"begins": True}
    assert third | {"error": ""} == last | {"begins": True}


def test_required_audit_says_why_a_change_cannot_be_recorded(tmp_path: Path, clock: Clock) -> None:
    file = FullDisk(tmp_path / "audit.jsonl")
    audit = required(file, clock)
    why = "the audit is required and cannot be written: No space left on device"
    assert audit.begin("island-01", entry()) == why
    assert audit.begin_request("uid 0, pid 7", "island-01", {}) == why
    # A refusal that is not recorded is lost; of those by ADS the gate has lines written.
    assert audit.lost == (1, 1_700_000_000.0, 1_700_000_000.0, "No space left on device")
    file.error = ""
    assert audit.begin("island-01", entry()) == ""
    assert audit.lost.error == ""


def test_required_audit_limits_changes_to_its_rate(tmp_path: Path, clock: Clock) -> None:
    audit = required(AuditFile(tmp_path / "audit.jsonl"), clock)
    assert audit.begin("island-01", entry(count=BURST)) == ""
    assert audit.begin("island-01", entry()) == module.TOO_MANY
    audit.write("island-01", entry(count=BURST))
    assert len(lines(audit)) == 2 * BURST  # what was begun is told to its end


def test_required_audit_limits_the_lines_of_a_control_client_that_it_refuses(
    tmp_path: Path, clock: Clock
) -> None:
    audit = required(AuditFile(tmp_path / "audit.jsonl"), clock)
    fields = {"operation": "od_write"}
    found = [audit.begin_request("uid 0, pid 7", "island-01", fields) for _ in range(BURST + 3)]
    assert found == [""] * BURST + [module.TOO_MANY] * 3
    audit.write_skipped()
    assert len(lines(audit)) == BURST + 1
    assert lines(audit)[-1]["skipped"] == 3


def test_audit_writes_skipped_lines_at_its_end(audit: Audit) -> None:
    async def serve_and_end() -> None:
        serving = asyncio.create_task(audit.serve())
        await asyncio.sleep(0)
        serving.cancel()
        await asyncio.wait([serving])

    audit.write("island-01", entry(count=BURST + 2))
    run_virtual(serve_and_end())
    assert lines(audit)[-1]["skipped"] == 2


def test_audit_that_is_not_required_begins_nothing(audit: Audit) -> None:
    assert audit.begin_request("uid 0, pid 7", "island-01", {}) == ""
    assert not audit.path.exists()
