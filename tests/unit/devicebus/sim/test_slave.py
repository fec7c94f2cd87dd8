"""The state machine of a slave: what it checks, refuses, waits for and falls back to."""

from __future__ import annotations

import pytest

from devicebus.sim.slave import (
    ALLOWED,
    OUTPUTS_TIMEOUT_NS,
    check_clock,
    check_mailbox,
    check_process_data,
)
from devicebus.sim.spec import ChannelSpec, ClockSpec
from devicebus.wire.alstatus import ERROR, AlState, AlStatusCode
from devicebus.wire.datagram import Command
from devicebus.wire.register import Register, SyncManager
from tests.support.bus import Bench, generic

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


UPLOAD_VENDOR = bytes.fromhex("0a00 0000 00 13 0020 40 1810 01 00000000")


def upload(counter: int, index: int = 0x1018, subindex: int = 1) -> bytes:
    return (
        bytes.fromhex("0a00 0000 00")
        + bytes((counter << 4 | 3,))
        + bytes.fromhex("0020 40")
        + index.to_bytes(2, "little")
        + bytes((subindex,))
        + bytes(4)
    )


@pytest.fixture
def bench():
    return Bench()


@pytest.mark.parametrize("state", [AlState.PREOP, AlState.SAFEOP, AlState.OP, AlState.BOOT])
def test_slave_steps_up_to_op(bench, state):
    bench.bring(state)
    assert bench.slaves[0].state is state
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.INIT, 0)


@pytest.mark.parametrize(
    ("start", "asked", "status", "code"),
    [
        (AlState.PREOP, AlState.OP, AlState.PREOP, AlStatusCode.INVALID_STATE_CHANGE),
        (AlState.PREOP, AlState.BOOT, AlState.PREOP, AlStatusCode.INVALID_STATE_CHANGE),
        (AlState.BOOT, AlState.PREOP, AlState.BOOT, AlStatusCode.INVALID_STATE_CHANGE),
        (AlState.OP, AlState.BOOT, AlState.SAFEOP, AlStatusCode.INVALID_STATE_CHANGE),
        (AlState.SAFEOP, 5, AlState.SAFEOP, AlStatusCode.UNKNOWN_STATE),
        (AlState.OP, 7, AlState.SAFEOP, AlStatusCode.UNKNOWN_STATE),
    ],
)
def test_slave_refuses_invalid_requests(bench, start, asked, status, code):
    bench.bring(start)
    bench.ask(asked)
    assert bench.status() == (status | ERROR, code)


def test_slave_error_ends_by_acknowledge_or_init(bench):
    bench.bring(AlState.PREOP)
    bench.ask(AlState.OP)
    bench.ask(AlState.SAFEOP)
    assert bench.status() == (AlState.PREOP | ERROR, AlStatusCode.INVALID_STATE_CHANGE)
    bench.ask(AlState.PREOP | ERROR)
    assert bench.status() == (AlState.PREOP, 0)
    bench.ask(AlState.OP)
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.INIT, 0)


@pytest.mark.parametrize("state", [AlState.SAFEOP, AlState.PREOP])
def test_slave_steps_down_to_init(bench, state):
    bench.bring(AlState.OP)
    bench.ask(state)
    assert bench.status() == (state, 0)
    assert bench.slaves[0].next_timeout() is None


def test_slave_refuses_preop_without_mailboxes(bench):
    bench.ask(AlState.PREOP)
    assert bench.status() == (AlState.INIT | ERROR, AlStatusCode.MAILBOX_PREOP)
    bench.ask(AlState.BOOT | ERROR)
    assert bench.status() == (AlState.INIT | ERROR, AlStatusCode.MAILBOX_BOOT)


def test_slave_refuses_boot_without_support():
    bench = Bench(generic(boot=False))
    bench.set_channels(0, 0, 2)
    bench.ask(AlState.BOOT)
    assert bench.status() == (AlState.INIT | ERROR, AlStatusCode.BOOT_NOT_SUPPORTED)


@pytest.mark.parametrize(
    ("channel", "code"),
    [(2, AlStatusCode.OUTPUT_CONFIGURATION), (3, AlStatusCode.INPUT_CONFIGURATION)],
)
def test_safeop_needs_channels_of_the_mapped_length(bench, channel, code):
    bench.bring(AlState.PREOP)
    bench.set_channels(0, 2)
    at = Register.SYNC_MANAGER + 8 * channel
    old = SyncManager.decode(bench.read(at, 8).data)
    bench.write(at, SyncManager(old.start, old.length + 1, enable=1).encode())
    bench.ask(AlState.SAFEOP)
    assert bench.status() == (AlState.PREOP | ERROR, code)


def test_op_needs_outputs(bench):
    bench.bring(AlState.SAFEOP)
    bench.ask(AlState.OP)
    assert bench.status() == (AlState.SAFEOP, 0)
    assert bench.segment.next_timeout() == OUTPUTS_TIMEOUT_NS
    bench.cycle()
    assert bench.status() == (AlState.OP, 0)


def test_slave_refuses_op_without_outputs(bench):
    bench.bring(AlState.SAFEOP)
    bench.ask(AlState.OP)
    bench.now_ns = OUTPUTS_TIMEOUT_NS
    assert bench.status() == (AlState.SAFEOP | ERROR, AlStatusCode.NO_OUTPUTS)


def test_slave_without_output_data_reaches_op_at_once():
    bench = Bench(generic(outputs=()))
    bench.bring(AlState.SAFEOP)
    bench.ask(AlState.OP)
    assert bench.status() == (AlState.OP, 0)


def test_outputs_count_in_op_only(bench):
    entry = bench.slaves[0].device.dictionary.entry(0x7000, 1)
    bench.bring(AlState.SAFEOP)
    bench.cycle(outputs=b"\x34\x12\x01")
    assert entry.value == 0
    bench.ask(AlState.OP)
    assert bench.cycle(outputs=b"\x34\x12\x01").wkc == 3
    assert entry.value == 0x1234
    assert bench.slaves[0].device.dictionary.entry(0x7000, 2).value is True


def test_inputs_reach_the_master(bench):
    bench.slaves[0].device.dictionary.entry(0x6000, 1).value = 0xABCD
    bench.slaves[0].device.dictionary.entry(0x6000, 2).value = True
    bench.bring(AlState.SAFEOP)
    assert bench.cycle().data[3:] == b"\xcd\xab\x01"


def test_outputs_that_stay_away_end_op(bench):
    bench.bring(AlState.OP)
    bench.cycle()
    bench.now_ns = 99_999_999
    assert bench.status() == (AlState.OP, 0)
    bench.now_ns = 101_000_000
    assert bench.status() == (AlState.SAFEOP | ERROR, AlStatusCode.WATCHDOG)
    assert bench.read(Register.WATCHDOG_COUNTER, 1).data == b"\x01"


def test_channel_switched_off_under_data_is_an_error(bench):
    bench.bring(AlState.OP)
    bench.write(Register.SYNC_MANAGER + 16 + 6, b"\x00")
    assert bench.status() == (AlState.PREOP | ERROR, AlStatusCode.OUTPUT_CONFIGURATION)


@pytest.mark.parametrize(
    ("state", "code"),
    [(AlState.PREOP, AlStatusCode.MAILBOX_PREOP), (AlState.OP, AlStatusCode.MAILBOX_PREOP),
     (AlState.BOOT, AlStatusCode.MAILBOX_BOOT)],
)  # fmt: skip
def test_slave_mailbox_disabled_during_use_is_an_error(bench, state, code):
    bench.bring(state)
    bench.write(Register.SYNC_MANAGER + 6, b"\x00")
    assert bench.status() == (AlState.INIT | ERROR, code)
    bench.ask(AlState.INIT)
    assert bench.status() == (AlState.INIT, 0)


def test_slave_refuses_op_without_a_required_sync0():
    bench = Bench(generic(clock=ClockSpec(needs_sync0=True)))
    bench.bring(AlState.SAFEOP)
    bench.cycle()
    bench.ask(AlState.OP)
    assert bench.status() == (AlState.SAFEOP | ERROR, AlStatusCode.DC_SYNC_CONFIGURATION)
    bench.write(Register.DC_SYNC0_CYCLE, (1_000_000).to_bytes(4, "little"))
    bench.write(Register.DC_ACTIVATION, b"\x03")
    bench.ask(AlState.SAFEOP | ERROR)
    bench.cycle()
    bench.ask(AlState.OP)
    assert bench.status() == (AlState.OP, 0)


def test_own_error_falls_out_of_op(bench):
    bench.bring(AlState.OP)
    bench.slaves[0].fail(AlStatusCode.SYNCHRONIZATION)
    assert bench.status() == (AlState.SAFEOP | ERROR, AlStatusCode.SYNCHRONIZATION)
    assert bench.slaves[0].code == AlStatusCode.SYNCHRONIZATION


def test_slave_refuses_states_of_a_fault(bench):
    bench.slaves[0].refused_states[AlState.PREOP] = 0x8000
    bench.set_channels(0, 0, 2)
    bench.ask(AlState.PREOP)
    assert bench.status() == (AlState.INIT | ERROR, 0x8000)


def test_identification_is_given_on_request():
    bench = Bench(generic(alias=0x0123))
    bench.ask(AlState.INIT | 0x20)
    assert bench.status() == (AlState.INIT | 0x20, 0x0123)


def test_mailbox_answers(bench):
    bench.bring(AlState.PREOP)
    assert bench.fetch().wkc == 0
    assert bench.post(UPLOAD_VENDOR) == 1
    reply = bench.fetch()
    assert (reply.wkc, reply.data[:16]) == (
        1,
        bytes.fromhex("0a00 0000 00 13 0030 43 1810 01 5a0e0000"),
    )
    assert bench.fetch().wkc == 0


def test_slave_mailbox_is_closed_in_init(bench):
    bench.set_channels(0, 0, 2)
    assert bench.post(UPLOAD_VENDOR) == 1
    assert bench.fetch().wkc == 0
    bench.ask(AlState.PREOP)
    assert bench.fetch().wkc == 0  # what was there before is forgotten


def test_boot_knows_files_only(bench):
    bench.bring(AlState.BOOT)
    bench.post(UPLOAD_VENDOR)
    assert bench.fetch().data[:10] == bytes.fromhex("0400 0000 00 10 0100 0200")
    bench.post(bytes.fromhex("0700 0000 00 24 0100 00000000 78"))
    assert bench.fetch().data[5:8] == bytes.fromhex("24 05 00")
    bench.ask(AlState.INIT)
    bench.bring(AlState.PREOP)
    bench.post(UPLOAD_VENDOR)
    assert bench.fetch().data[8] == 0x43


def test_slave_repeats_a_lost_reply(bench):
    bench.bring(AlState.PREOP)
    bench.post(upload(1))
    first = bench.fetch().data
    assert bench.fetch().wkc == 0
    bench.write(0x080E, b"\x03")
    assert bench.read(0x080F, 1).data == b"\x02"
    assert bench.fetch().data == first
    assert bench.fetch().wkc == 0


def test_message_not_read_yet_follows_the_repeated_one(bench):
    bench.bring(AlState.PREOP)
    bench.post(upload(1, 0x1018, 1))
    first = bench.fetch().data
    bench.post(upload(2, 0x1018, 2))
    bench.write(0x080E, b"\x03")
    assert bench.fetch().data == first
    second = bench.fetch()
    assert (second.wkc, second.data[11]) == (1, 2)


def test_slave_queues_a_second_request(bench):
    bench.bring(AlState.PREOP)
    assert bench.post(upload(1, 0x1018, 1)) == 1
    assert bench.post(upload(2, 0x1018, 2)) == 1
    assert [bench.fetch().data[11] for _ in range(2)] == [1, 2]


def test_emulated_device_follows_al_control():
    bench = Bench(generic(mailbox=None, inputs=(), outputs=()))
    assert bench.slaves[0].esc.emulates_device
    bench.ask(AlState.OP)
    assert bench.status() == (AlState.OP, 0)
    bench.ask(AlState.PREOP | ERROR)
    assert bench.status() == (AlState.PREOP | ERROR, 0)


def test_simple_device_exchanges_without_a_mailbox():
    bench = Bench(generic(mailbox=None, inputs=(ChannelSpec(name="in"),),
                          outputs=(ChannelSpec(name="out"),)))  # fmt: skip
    bench.bring(AlState.OP)
    assert bench.cycle(outputs=b"\x01").wkc == 3
    assert bench.slaves[0].device.dictionary.entry(0x7000, 1).value is True


def test_slave_power_cycle_resets_it(bench):
    bench.bring(AlState.OP)
    bench.slaves[0].switch(on=False)
    assert not bench.slaves[0].is_powered
    bench.slaves[0].handle_timeout(10**12)
    bench.slaves[0].switch(on=True)
    assert bench.slaves[0].state is AlState.INIT
    assert bench.send(Command.APRD, 0, Register.AL_STATUS, bytes(2)).data == b"\x01\x00"


def test_sync0_lets_the_device_act():
    bench = Bench()
    steps = []

    class Counting:
        def step(self, state, now_ns):
            steps.append(now_ns)

    bench.slaves[0].device.behaviour = Counting()
    bench.bring(AlState.SAFEOP)
    bench.write(Register.DC_SYNC0_CYCLE, (1_000_000).to_bytes(4, "little"))
    bench.write(Register.DC_ACTIVATION, b"\x03")
    steps.clear()
    bench.now_ns = 5_000_000
    bench.status()
    assert steps == [5_000_000]
