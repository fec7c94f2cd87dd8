"""Information of a bus about its slaves."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.errors import BusError, SiiError
from devicebus.wire import sii
from eap.ops.bus_info import (
    ErrorOrigin,
    WrittenEeprom,
    diagnosis,
    fault_lines,
    read_eeprom,
    reset_diagnosis,
    scan_slaves,
    slave_states,
    write_eeprom,
)
from tests.support.loopbus import LoopBus


@pytest.fixture
def line():
    return LoopBus("coe")


def test_scan(line):
    with line.session() as bus:
        rows = scan_slaves(bus).slaves
    assert msgspec.to_builtins(rows[2]) == {
        "address": 1003,
        "name": "sensor",
        "vendor": 0xE5A,
        "product": 0x0BBC3052,
        "revision": 0x10000,
        "serial": 0,
        "alias": 0,
        "state": "INIT",
        "code": 0,
        "mailbox": ["CoE"],
        "parent": 1,
        "ports": (0,),
        "fault": "",
        "is_absent": False,
    }
    assert [row.parent for row in rows] == [None, 0, 1]


def test_fault_lines_name_the_slaves_of_each_fault_together():
    faults = {"a": "it does not answer", "b": "it does not answer", "c": "", "d": "no end"}
    with LoopBus("coe").session() as bus:
        (slave, *_) = scan_slaves(bus).slaves
    rows = [
        msgspec.structs.replace(slave, address=1, name=name, fault=fault)
        for name, fault in faults.items()
    ]
    assert fault_lines(rows) == ["a (1), b (1): does not answer", "d (1): no end"]


def test_states(line):
    with line.session() as bus:
        assert [row.state for row in slave_states(bus, None, None).slaves] == ["INIT"] * 3
        assert [row.state for row in slave_states(bus, None, "PREOP").slaves] == ["PREOP"] * 3
        (row,) = slave_states(bus, "sensor", "SAFEOP").slaves
        assert (row.address, row.state, row.reason) == (1003, "SAFEOP", "")


def test_slave_state_has_the_reason_of_a_refusal(line):
    line.fault(kind="refuse", slave="sensor", state="PREOP", code=0x51)
    with line.session() as bus:
        with pytest.raises(BusError):
            slave_states(bus, "sensor", "PREOP")
        (row,) = slave_states(bus, "sensor", None).slaves
    assert (row.state, row.code, row.reason) == ("INIT+ERROR", 0x51, "EEPROM error")


def test_slave_state_has_the_fault_that_its_master_knows(line, monkeypatch):
    fault = "slave 1003: start-up write of 0x8000:02 in PS (data f4 01): value is out of range"
    with line.session() as bus:
        known = [msgspec.structs.replace(each, fault=fault) for each in bus.scan()]
        monkeypatch.setattr(bus, "scan", lambda: known)
        row = slave_states(bus, None, None).slaves[2]
        assert row.reason == fault.removeprefix("slave 1003: ")
        # All slaves reach a requested state, or the command fails: the old fault is over.
        assert [row.reason for row in slave_states(bus, None, "PREOP").slaves] == [""] * 3


def test_diagnosis_of_a_sound_bus(line):
    with line.session() as bus:
        found = diagnosis(bus, None, 100.0)
    assert found.starts_at is None
    assert found.frames.lost == 0
    slave = found.slaves[1]
    assert (slave.address, slave.name, slave.state) == (1002, "buttons", "INIT")
    assert [port.is_open for port in slave.ports] == [True, True, False, False]


def test_diagnosis_names_where_damage_starts(line):
    memory = line.segment.segment.slaves[1].esc.memory
    memory[0x0300] = 3
    memory[0x0311] = 2
    with line.session() as bus:
        found = diagnosis(bus, None, 100.0)
        (only,) = diagnosis(bus, "buttons", 100.0).slaves
    assert found.starts_at == ErrorOrigin(slave=1002, name="buttons", port=0, neighbour=1001)
    (finding,) = found.findings
    assert finding.what == "errors start at port 0 of buttons (1002): 3 invalid frames"
    assert finding.advice == "check its cable to coupler (1001) first"
    assert (finding.is_over, finding.until) == (False, None)
    assert only.ports[0].invalid_frames == 3
    assert only.ports[1].lost_links == 2


def test_diagnosis_of_a_silent_bus_is_one_finding(line):
    with line.session() as bus:
        bus.scan()
        line.fault(kind="loss")
        found = diagnosis(bus, None, 100.0)
    assert [each.what for each in found.findings] == [
        "no frame comes back: 3 slaves cannot be reached"
    ]
    assert not any(each.answers for each in found.slaves)


def test_diagnosis_of_a_bus_that_loses_a_frame_is_no_silence(line):
    with line.session() as bus:
        bus.scan()
        line.fault(kind="loss", for_ms=20)
        assert diagnosis(bus, None, 100.0).findings == []


def test_reset_diagnosis_clears_the_counters(line):
    line.segment.segment.slaves[1].esc.memory[0x0300] = 3
    with line.session() as bus:
        assert reset_diagnosis(bus).reset == [1001, 1002, 1003]
        assert diagnosis(bus, None, 100.0).findings == []


def test_eeprom_is_written_and_read_back(line):
    with line.session() as bus:
        content = read_eeprom(bus, "sensor")
        image = bytes.fromhex(content.data)
        assert (content.name, content.vendor, content.intact) == ("sensor", 0xE5A, True)
        assert content.octets == len(image)
        changed = bytearray(image)
        changed[8] = 7  # the alias
        changed[sii.CHECKED] = sii.checksum(changed[: sii.CHECKED])
        written = write_eeprom(bus, "sensor", bytes(changed))
        assert written == WrittenEeprom(1003, "sensor", len(image))
        assert read_eeprom(bus, "sensor").data == changed.hex()


def test_image_that_no_slave_would_load(line):
    with line.session() as bus:
        image = bytearray.fromhex(read_eeprom(bus, "sensor").data)
        image[0] ^= 1
        with pytest.raises(SiiError, match="wrong checksum"):
            write_eeprom(bus, "sensor", bytes(image))
