from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError, SiiError, WorkingCounterError
from devicebus.master.bring import (
    boot_mailbox,
    bring,
    clear,
    set_process_data,
    standard_mailbox,
)
from devicebus.master.bus import MasterSettings
from devicebus.master.configuration import set_watchdog, wait_for
from devicebus.master.image import plan_image
from devicebus.master.mailboxes import MailboxArea
from devicebus.master.master import Master
from devicebus.master.scan import assign_stations
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.sii import SiiFixed
from tests.support.busline import Bench, Line, Paced, expect, run, segment, slave
from tests.unit.devicebus.master.test_image import shape

FIXED = SiiFixed(
    boot_receive_offset=1, boot_receive_size=20, boot_send_offset=3, boot_send_size=40,
    receive_offset=5, receive_size=60, send_offset=7, send_size=8,
)  # fmt: skip


@pytest.fixture
def line():
    line = Line(Bench(), segment(slave("a")))
    run(line, assign_stations([(0, 1001)]))
    return line


def test_mailboxes_by_state():
    assert standard_mailbox(FIXED) == MailboxArea(5, 60, 7, 8)
    assert boot_mailbox(FIXED) == MailboxArea(1, 20, 3, 40)
    assert boot_mailbox(FIXED).is_there
    assert not standard_mailbox(FIXED).is_there


def test_process_data_is_set_up_and_cleared(line):
    (place,) = plan_image([shape(1001, (8,), (16,))]).slaves.values()
    run(line, set_process_data(place))
    memory = line.segment.slaves[0].esc.memory
    managers = [SyncManager.decode(memory, Register.SYNC_MANAGER + 8 * n) for n in (2, 3)]
    assert [(each.start, each.length, each.enable) for each in managers] == [
        (0x1100, 1, 1),
        (0x1100, 2, 1),
    ]
    fmmus = tuple(Fmmu.decode(memory, Register.FMMU + 16 * n) for n in (0, 1))
    assert fmmus == place.fmmus
    run(line, clear(1001, fmmus=8, sync_managers=8))
    assert not any(memory[Register.FMMU : Register.FMMU + 128])
    assert not SyncManager.decode(memory, Register.SYNC_MANAGER + 16).enable
    run(line, clear(1001, fmmus=0, sync_managers=0))
    run(line, clear(1001, fmmus=255, sync_managers=255))


def test_set_watchdog_in_milliseconds(line):
    run(line, set_watchdog(1001, 250))
    memory = line.segment.slaves[0].esc.memory
    assert memory[Register.WATCHDOG_DIVIDER : Register.WATCHDOG_DIVIDER + 2] == b"\xc2\x09"
    at = Register.WATCHDOG_PROCESS_DATA
    assert int.from_bytes(memory[at : at + 2], "little") == 2500
    with pytest.raises(ValueError, match="watchdog of 7000 ms, expected 0 to 6553"):
        run(line, set_watchdog(1001, 7000))


def test_bring_lost_slave_fails(line):
    (place,) = plan_image([shape(1005, (8,))]).slaves.values()
    with pytest.raises(WorkingCounterError, match="slave 1005: writing sync manager 2"):
        run(line, set_process_data(place))


def line_of(*slaves, **settings):
    line = Paced(Master(MasterSettings(**settings)), segment(*slaves))
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    return line


def request(line, target, station=1001):
    line.wait(line.core.request_state(station, target, line.now_ns))
    return line.segment.slaves[station - 1001]


def test_mailboxes_open_and_close_with_the_states():
    line = line_of(slave("a"))
    unit = line.core.slaves[1001]
    preop = unit.mailbox
    assert preop is not None
    request(line, AlState.INIT)
    assert unit.mailbox is None
    assert request(line, AlState.BOOT).state is AlState.BOOT
    assert unit.mailbox is not preop
    assert request(line, AlState.PREOP).state is AlState.PREOP
    assert unit.state is AlState.PREOP


def test_bring_writes_the_pdo_configuration_before_reading():
    expected = [expect(slave("a"), assignment={2: (), 3: (0x1A00,)})]
    line = Paced(Master(MasterSettings(expected=expected)), segment(slave("a")))
    line.wait(line.core.bring_up(line.now_ns))
    assert [each.name for each in line.core.image.layout.variables] == ["in"]
    assert line.segment.slaves[0].state is AlState.OP


def test_bring_sets_the_watchdog_if_configured():
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


def test_bring_reports_a_refused_state():
    line = line_of(slave("a"))
    line.segment.slaves[0].refused_states[AlState.SAFEOP] = 0x1E
    with pytest.raises(AlStatusError, match="0x001E, invalid input configuration"):
        request(line, AlState.SAFEOP)
    assert line.core.slaves[1001].state is AlState.PREOP


def test_bring_leaves_a_slave_without_eeprom_alone():
    line = line_of(slave("a"))
    unit = line.core.slaves[1001]
    unit.found = unit.found._replace(fault="its EEPROM is empty")
    frames = line.frames
    with pytest.raises(SiiError, match="its EEPROM is empty"):
        line.wait(line.core.run(bring(line.core._bus, unit, AlState.INIT), line.now_ns))
    assert line.frames == frames


def test_wait_for_returns_the_result_of_a_task():
    line = line_of(slave("a"))
    scanning = line.core.scan(line.now_ns)
    assert len(line.wait(line.core.run(wait_for(scanning), line.now_ns))) == 1
