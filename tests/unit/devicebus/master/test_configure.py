from __future__ import annotations

import pytest

from devicebus.errors import WorkingCounterError
from devicebus.master.configure import (
    boot_mailbox,
    clear,
    set_process_data,
    set_watchdog,
    standard_mailbox,
)
from devicebus.master.layout import lay_out
from devicebus.master.mailboxport import MailboxArea
from devicebus.master.scan import assign_stations
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.siirecord import SiiFixed
from tests.support.busline import Bench, Line, run, segment, slave
from tests.unit.devicebus.master.test_layout import shape

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
    (place,) = lay_out([shape(1001, (8,), (16,))]).places.values()
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


def test_the_watchdog_is_set_in_milliseconds(line):
    run(line, set_watchdog(1001, 250))
    memory = line.segment.slaves[0].esc.memory
    assert memory[Register.WATCHDOG_DIVIDER : Register.WATCHDOG_DIVIDER + 2] == b"\xc2\x09"
    at = Register.WATCHDOG_PROCESS_DATA
    assert int.from_bytes(memory[at : at + 2], "little") == 2500
    with pytest.raises(ValueError, match="watchdog of 7000 ms, expected 0 to 6553"):
        run(line, set_watchdog(1001, 7000))


def test_a_slave_that_is_gone(line):
    (place,) = lay_out([shape(1005, (8,))]).places.values()
    with pytest.raises(WorkingCounterError, match="slave 1005: writing sync manager 2"):
        run(line, set_process_data(place))
