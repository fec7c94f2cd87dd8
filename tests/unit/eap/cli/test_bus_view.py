"""Slaves, objects and IDNs as people see them."""

from __future__ import annotations

import io

import msgspec
import pytest
from rich.console import Console

from eap.cli.bus_view import (
    diagnosis_view,
    dump_table,
    eeprom_lines,
    finding_line,
    idn_lines,
    idn_table,
    object_table,
    scan_tables,
    state_view,
    value_line,
)
from eap.ops.bus_info import BusScan, Diagnosis, EepromContent, SlaveStates
from eap.ops.bus_objects import (
    IdnElements,
    NamedIdn,
    SdoDumpEntry,
    SdoValue,
    SlaveObject,
)
from eap.runtime.bus_status import FindingRow
from tests.support.records import record


def shown(*parts):
    console = Console(file=io.StringIO(), width=120, highlight=False)
    for part in parts:
        console.print(part)
    return console.file.getvalue()


def port(number, **counters):
    none = dict.fromkeys(("invalid_frames", "physical", "forwarded", "lost_links"), 0)
    return {"port": number, "is_open": number == 0, **none, **counters}


def test_slave_whose_eeprom_is_unreadable():
    row = {"address": 1001, "name": "", "vendor": 0, "product": 0, "revision": 0, "serial": 0,
           "alias": 7, "state": "INIT+ERROR", "mailbox": [], "fault": "no end",
           "code": 0, "parent": None, "ports": []}  # fmt: skip
    gone = row | {
        "address": 1002,
        "name": "b",
        "state": None,
        "fault": "it does not answer",
        "mailbox": None,
    }
    text = shown(*scan_tables(record(BusScan, slaves=[row, gone])))
    assert "b (1002) does not answer" in text
    assert "no answer" in text
    assert "INIT+ERROR" in text
    assert "?" in text


def test_scan_of_a_bus_that_is_not_as_configured_has_expected_slaves_beside_found_ones():
    row = {"address": 1001, "name": "drive", "vendor": 1, "product": 2, "revision": 0, "serial": 0,
           "alias": 0, "state": "INIT", "mailbox": [], "fault": "", "code": 0, "parent": None,
           "ports": []}  # fmt: skip
    expected = [{"address": 1001, "name": "axis"}, {"address": 1002, "name": "valve"}]
    fault = "not as configured:\n  valve is missing"
    text = shown(*scan_tables(record(BusScan, slaves=[row], fault=fault, expected=expected)))
    (first, second, *_, head, line) = text.splitlines()[2:]
    assert first.split()[:3] == ["1001", "drive", "axis"]
    assert second.split() == ["1002", "valve"]
    assert (head, line) == ("not as configured:", "  valve is missing")


def test_state_with_its_reason():
    row = {"address": 1001, "name": "a", "state": "INIT+ERROR", "code": 0x51, "reason": "bad"}
    gone = row | {"state": None, "code": 0, "reason": "it does not answer"}
    text = shown(*state_view(record(SlaveStates, slaves=[row, gone]), ""))
    assert "bad (0x0051)" in text
    assert "no answer" in text
    assert "it does not answer (" not in text


FRAMES = {
    "sent": 1,
    "received": 1,
    "late": 3,
    "lost": 0,
    "retried": 2,
    "timeout_us": 2000,
    "round_trip_us": 480,
}
NOW_S = 1_000_000_000.0
OVER = {"what": "b (1002) did not answer", "advice": "check", "port": None, "is_over": True,
        "slaves": [{"address": 1002, "name": "b"}],
        "since": NOW_S - 30, "until": NOW_S - 12}  # fmt: skip
PRESENT = OVER | {"what": "c (1003) does not answer", "is_over": False, "until": None}


def diagnosis(slaves, *findings):
    found = {"slaves": slaves, "frames": FRAMES, "findings": findings, "starts_at": None}
    return msgspec.convert(found, Diagnosis)


def diagnosed(address, **more):
    row = {"address": address, "name": f"s{address}", "state": "OP", "code": 0, "reason": "",
           "answers": True, "ports": [port(0), port(1)]}  # fmt: skip
    return row | more


def test_diagnosis_shows_ports_frames_and_findings():
    bad = diagnosed(1002, ports=[port(0, invalid_frames=3), port(1), port(2, lost_links=9)])
    gone = diagnosed(1003, state="", answers=False, ports=[])
    found = diagnosis([bad, gone], PRESENT, OVER)
    lines = [line.rstrip() for line in shown(*diagnosis_view(found, NOW_S)).splitlines()]
    assert lines[-3:] == [
        "round trip 480 µs, timeout 2.0 ms",
        "since 30.0 s ago: c (1003) does not answer; check",
        "was, until 12.0 s ago: b (1002) did not answer; --reset clears this",
    ]
    assert lines[-4] == "1 frame sent, 3 late, 0 lost, 2 repeated"
    assert any("no answer" in line for line in lines)


def test_diagnosis_shows_the_ports_of_ethernet():
    port = {"station": 1001, "name": "drive", "is_connected": True, "ip": "10.0.0.2", "fault": "",
            "received": 7, "sent": 8, "dropped": 9, "invalid": 1, "failed": 2, "last_error": "",
            "addresses": ["02:01:05:30:03:e9"]}  # fmt: skip
    slaves = [port, port | {"ip": ""}, port | {"is_connected": False}]
    eoe = {"interface": "eoe0", "address": "", "fault": "", "received": 3, "sent": 4, "dropped": 5,
           "slaves": slaves}  # fmt: skip
    found = {"slaves": [], "frames": FRAMES, "findings": [], "starts_at": None, "eoe": eoe}

    def rows(document):
        text = shown(*diagnosis_view(msgspec.convert(document, Diagnosis), NOW_S))
        return [line.split() for line in text.splitlines()][-4:]

    assert rows(found) == [
        ["eoe0", "open", "3", "4", "5"],
        ["1001", "drive", "10.0.0.2", "7", "8", "9", "1", "2"],
        ["1001", "drive", "02:01:05:30:03:e9", "7", "8", "9", "1", "2"],
        ["1001", "drive", "no", "mailbox", "7", "8", "9", "1", "2"],
    ]
    dead = found | {"eoe": eoe | {"fault": "not permitted"}}
    assert rows(dead)[0] == ["eoe0", "not", "open", "3", "4", "5"]


def test_diagnosis_of_many_slaves_omits_those_without_errors():
    rows = [diagnosed(1001 + number) for number in range(100)]
    rows[49] = diagnosed(1050, ports=[port(0, lost_links=1)])
    found = diagnosis(rows, PRESENT)
    short = shown(*diagnosis_view(found, NOW_S))
    assert "not shown: 98 slaves without errors (--full shows them)" in short
    assert "s1002" in short
    assert "s1050" in short
    assert "s1100" in shown(*diagnosis_view(found, NOW_S, is_full=True))


def test_diagnosis_marks_counters_of_an_unknown_time():
    assert finding_line(msgspec.convert(OVER | {"until": None}, FindingRow), NOW_S) == (
        "was, before the master started: b (1002) did not answer; --reset clears this"
    )


def test_eeprom():
    content = {"address": 1001, "name": "", "vendor": 1, "product": 2, "revision": 3, "serial": 4,
               "intact": False, "octets": 17, "categories": []}  # fmt: skip
    found = record(EepromContent, **content, data=bytes(17).hex())
    lines = list(eeprom_lines(found, has_octets=True))
    assert lines[0] == "slave 1001: no name"
    assert lines[-4:-2] == ["  checksum WRONG; 17 bytes", "  categories (bytes) none"]
    assert lines[-1] == "0010  00"


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ({"type": "UINT", "value": 5, "data": "0500"}, "UINT 5 (0x0005)"),
        ({"type": "BOOL", "value": True, "data": "01"}, "BOOL true"),
        ({"type": "REAL", "value": 0.5, "data": "0000003f"}, "REAL 0.5"),
        ({"type": "STRING(2)", "value": "ab", "data": "6162"}, "STRING(2) ab"),
        ({"type": None, "value": 1, "data": "01"}, "1 (0x01)"),
        ({"type": None, "value": None, "data": "010203"}, "[01 02 03] (3 bytes)"),
        ({"type": "BLOCK(1)", "value": "07", "data": "07"}, "BLOCK(1) [07]"),
    ],
)
def test_value(row, text):
    found = record(SdoValue, index=0x1018, subindex=1, **row)
    assert value_line(found) == f"0x1018:01 = {text}"


def test_objects_and_entries():
    assert "RECORD" in shown(
        *object_table([record(SlaveObject, index=1, name="x", code="RECORD", max_subindex=3)])
    )
    own = {"index": 1, "subindex": 2, "object": "Whole", "name": "Part"}
    text = shown(
        *dump_table(
            record(SdoDumpEntry, **row)
            for row in [
                own | {"type": "BLOCK(40)", "access": "rw", "value": "00" * 40, "data": "00" * 40},
                own | {"type": "UINT", "access": "w", "value": None, "data": None},
                own | {"name": "", "error": "broken"},
            ]
        )
    )
    assert "Whole: Part" in text
    assert "(40 bytes)" in text
    assert "broken" in text


def test_idns():
    row = {"idn": "S-0-0024", "value": [1, 2], "unit": "mm", "name": "Targets", "minimum": None,
           "maximum": 5, "default": None, "data_state": None, "display": "SIGNED", "octets": 2,
           "decimals": 1, "factor": 10, "is_list": True, "is_command": False,
           "protected_in": ["SAFEOP", "OP"]}  # fmt: skip
    row |= {"slave": 1, "drive": 0}
    assert list(idn_lines(IdnElements(**row))) == [
        "S-0-0024 = 1, 2 mm",
        "  name       Targets",
        "  maximum    5",
        "  attribute  signed, 2 bytes each, a list, 1 decimal, factor 10, read only in SAFEOP, OP",
    ]
    command = row | {"is_list": False, "is_command": True, "data_state": 7, "protected_in": []}
    assert list(idn_lines(IdnElements(**command)))[-2:] == [
        "  attribute  signed, 2 bytes, 1 decimal, factor 10, a procedure command",
        "  data state 0x0007 (executing)",
    ]
    assert "Targets" in shown(*idn_table([NamedIdn("S-0-0024", 24, "Targets")]))


def test_diagnosis_has_columns_of_mailbox_timeouts_where_there_are_any() -> None:
    row = {"address": 1001, "name": "a", "state": "OP", "code": 0, "reason": "", "answers": True,
           "ports": [port(0)]}  # fmt: skip
    frames = dict.fromkeys(
        ("sent", "received", "late", "lost", "retried", "timeout_us", "round_trip_us"), 0
    )

    def table(**counters: int) -> str:
        found = {"frames": frames, "findings": [], "starts_at": None, "slaves": [row | counters]}
        return shown(*diagnosis_view(record(Diagnosis, **found), 0.0))

    assert "timeouts" not in table()
    text = table(mailbox_timeouts=3, mailbox_late=2)
    assert "timeouts" in text
    assert any(line.split()[-2:] == ["3", "2"] for line in text.splitlines())
