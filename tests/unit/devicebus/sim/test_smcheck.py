"""What a slave checks before it changes its state."""

from __future__ import annotations

import pytest

from devicebus.sim.smcheck import ALLOWED, check_clock, check_mailbox, check_process_data
from devicebus.wire.alstatus import AlState, AlStatusCode
from devicebus.wire.register import SyncManager
from tests.support.bus import Bench

OUT = SyncManager(0x1000, 64, 2, 1, enable=1)
IN = SyncManager(0x1040, 64, 2, 0, enable=1)


def test_every_state_can_be_left_to_init_and_kept():
    assert set(ALLOWED) == set(AlState)
    assert all({AlState.INIT, state} <= targets for state, targets in ALLOWED.items())


@pytest.mark.parametrize(
    ("first", "second", "fits"),
    [
        (OUT, IN, True),
        (IN, OUT, False),
        (OUT, SyncManager(0x1040, 64, 2, 0), False),
        (OUT, SyncManager(0x1040, 64, 0, 0, enable=1), False),
        (OUT, SyncManager(0x1040, 15, 2, 0, enable=1), False),
        (OUT, SyncManager(0x103F, 64, 2, 0, enable=1), False),
        (SyncManager(0x1080, 64, 2, 1, enable=1), IN, True),
    ],
)
def test_mailbox(first, second, fits):
    bench = Bench()
    bench.write(0x0800, first.encode())
    bench.write(0x0808, second.encode())
    assert check_mailbox(bench.slaves[0].esc) is fits


@pytest.mark.parametrize(
    ("channel", "setting", "code"),
    [
        (2, SyncManager(0x1200, 3, 0, 1, enable=1), AlStatusCode.NO_ERROR),
        (2, SyncManager(0x1200, 3, 0, 0, enable=1), AlStatusCode.SYNC_MANAGER),
        (2, SyncManager(0x1200, 3, 2, 1, enable=1), AlStatusCode.SYNC_MANAGER),
        (2, SyncManager(0x1200, 2, 0, 1, enable=1), AlStatusCode.OUTPUT_CONFIGURATION),
        (2, SyncManager(0x1200, 3, 0, 1), AlStatusCode.OUTPUT_CONFIGURATION),
        (3, SyncManager(0x1300, 4, 0, 0, enable=1), AlStatusCode.INPUT_CONFIGURATION),
        (2, SyncManager(0x1258, 3, 0, 1, enable=1), AlStatusCode.SYNC_MANAGER),
        (2, SyncManager(0x11FE, 3, 0, 1, enable=1), AlStatusCode.SYNC_MANAGER),
    ],
)
def test_process_data(channel, setting, code):
    bench = Bench()
    bench.set_channels()
    bench.write(0x0800 + 8 * channel, setting.encode())
    assert check_process_data(bench.slaves[0].esc, bench.slaves[0].device) == code


@pytest.mark.parametrize(
    ("activation", "cycle", "needs", "code"),
    [
        (0, 0, False, AlStatusCode.NO_ERROR),
        (0, 0, True, AlStatusCode.DC_SYNC_CONFIGURATION),
        (3, 0, False, AlStatusCode.DC_SYNC_CONFIGURATION),
        (3, 1000, True, AlStatusCode.NO_ERROR),
    ],
)
def test_clock(activation, cycle, needs, code):
    bench = Bench()
    slave = bench.slaves[0]
    slave.device.needs_sync0 = needs
    bench.write(0x09A0, cycle.to_bytes(4, "little"))
    bench.write(0x0981, bytes((activation,)))
    assert check_clock(slave.esc, slave.device) == code
