"""The words of the control protocol about devices."""

from __future__ import annotations

from msgspec import to_builtins

from eap.control import device as words
from eap.device.configuration import ChangeKind, EntryChange
from eap.device.eap_state import StateResult
from eap.od.model import WO, Entry, record
from eap.pd.device import DeviceFault, DeviceState, FaultCode
from eap.runtime.device_change import Plan


def test_rows_of_objects_and_entries():
    item = record(0x2000, "Key", {2: Entry("Secret", "UINT", WO, 5, unit=0xFA030000, maximum=9)})
    assert to_builtins(words.object_row(item, "front door")) == {
        "index": 0x2000,
        "name": "Key",
        "label": "front door",
        "code": "RECORD",
        "max_subindex": 2,
    }
    row = words.described_object(item, "").entries[-1]
    assert (row.access, row.unit, row.default, row.maximum) == ("w", "us", "0500", 9)


def test_states():
    assert words.state_answer(StateResult(DeviceState.OP, None)) == words.StateAnswer("OP", None)
    fault = DeviceFault(FaultCode.NO_PDO, "none", 0xD001, 1, "eap0")
    assert to_builtins(words.state_answer(StateResult(DeviceState.PREOP, fault)).error) == {
        "code": 0x8002,
        "text": "0xD001:01: PD has no PDO: none",
        "port": "eap0",
        "index": 0xD001,
        "subindex": 1,
    }
    assert [words.state_of(word) for word in ("PREOP", "safeop", "OP", "BOOT", "")] == [
        2,
        4,
        8,
        0,
        0,
    ]


def test_outcomes(stations):
    changes = [
        (
            "eap0",
            EntryChange(ChangeKind.CHANGED, 0xD000, 3, "PD ID", "1", "0", b"\0\0", interim=True),
        ),
        ("eap0", EntryChange(ChangeKind.CHANGED, 0xD000, 3, "PD ID", "1", "2", b"\2\0")),
    ]
    plan = Plan(stations[0], changes, ["link a to b: added"], [], {})
    shown = words.plan_answer(plan)
    assert [row.new for row in shown.changes] == ["2"]
    assert shown.station == ["link a to b: added"]
    done = words.apply_answer(plan, None)
    assert (done.ok, done.refused) == (True, [])
    assert [(row.ok, row.reason) for row in done.results] == [(True, "")]
    failed = words.apply_answer(plan, DeviceFault(FaultCode.NOT_RUNNING, "x"))
    reason = "engine did not take the configuration: x"
    assert (failed.ok, failed.refused) == (False, [reason])
    assert [(row.ok, row.reason) for row in failed.results] == [(False, reason)]
    refused = words.apply_answer(Plan(stations[0], [], [], ["no"], {}), None)
    assert (refused.ok, refused.results, refused.refused) == (False, [], ["no"])
