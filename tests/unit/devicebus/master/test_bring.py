from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError, SiiError
from devicebus.master.bring import bring, wait_for
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.master.pdo import PdoChoice
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from tests.support.busline import Paced, segment, slave


def line_of(*slaves, **settings):
    line = Paced(Master(MasterSettings(**settings)), segment(*slaves))
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    return line


def request(line, target, station=1001):
    line.wait(line.core.request_state(station, target, line.now_ns))
    return line.segment.slaves[station - 1001]


def test_mailboxes_open_and_close_with_the_states():
    line = line_of(slave("a"))
    unit = line.core.units[1001]
    preop = unit.mailbox
    assert preop is not None
    request(line, AlState.INIT)
    assert unit.mailbox is None
    assert request(line, AlState.BOOT).state is AlState.BOOT
    assert unit.mailbox is not preop
    assert request(line, AlState.PREOP).state is AlState.PREOP
    assert unit.state is AlState.PREOP


def test_a_choice_of_pdos_is_written_before_they_are_read():
    choice = PdoChoice(assignment={2: (), 3: (0x1A00,)})
    line = Paced(Master(MasterSettings(choices={1001: choice})), segment(slave("a")))
    line.wait(line.core.bring_up(line.now_ns))
    assert [each.name for each in line.core.image.layout.variables] == ["in"]
    assert line.segment.slaves[0].state is AlState.OP


def test_the_watchdog_is_set_when_asked_for():
    line = Paced(Master(MasterSettings(watchdog_ms=20)), segment(slave("a")))
    line.wait(line.core.bring_up(line.now_ns))
    memory = line.segment.slaves[0].esc.memory
    at = Register.WATCHDOG_PROCESS_DATA
    assert memory[at : at + 2] == (200).to_bytes(2, "little")


def test_slaves_without_boot_say_so():
    line = line_of(slave("a", boot=False), slave("b", mailbox=None))
    for station in (1001, 1002):
        with pytest.raises(BusError, match=f"slave {station}: its EEPROM names no mailbox"):
            request(line, AlState.BOOT, station)


def test_refusals_are_told():
    line = line_of(slave("a"))
    line.segment.slaves[0].refuses[AlState.SAFEOP] = 0x1E
    with pytest.raises(AlStatusError, match="0x001E, invalid input configuration"):
        request(line, AlState.SAFEOP)
    assert line.core.units[1001].state is AlState.PREOP


def test_a_slave_nobody_knows_anything_of_is_not_touched():
    line = line_of(slave("a"))
    unit = line.core.units[1001]
    unit.found = unit.found._replace(fault="its EEPROM is empty")
    frames = line.frames
    with pytest.raises(SiiError, match="its EEPROM is empty"):
        line.wait(line.core.run(bring(line.core._bus, unit, AlState.INIT), line.now_ns))
    assert line.frames == frames


def test_a_procedure_may_wait_for_a_task():
    line = line_of(slave("a"))
    scanning = line.core.scan(line.now_ns)
    assert len(line.wait(line.core.run(wait_for(scanning), line.now_ns))) == 1
