"""Sync managers: mailboxes that change hands, buffers that never wait."""

from __future__ import annotations

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from devicebus.sim.syncmanager import SyncChannel, Watchdog
from devicebus.wire.register import Register, SyncManager

START, SIZE = 0x1000, 16


def make(
    *, mode: int, direction: int, number: int = 0, **more: int
) -> tuple[SyncChannel, bytearray]:
    memory = bytearray(0x2000)
    octets = SyncManager(START, SIZE, mode, direction, enable=1, **more).encode()
    at = Register.SYNC_MANAGER + 8 * number
    memory[at : at + 8] = octets
    return SyncChannel(memory, number), memory


def mailbox_out(**more: int) -> tuple[SyncChannel, bytearray]:
    return make(mode=2, direction=1, **more)


def mailbox_in() -> tuple[SyncChannel, bytearray]:
    return make(mode=2, direction=0, number=1)


def status(memory: bytearray, number: int = 0) -> int:
    return memory[Register.SYNC_MANAGER + 8 * number + 5]


def test_sync_channel_mailbox_is_full_with_its_last_byte():
    channel, memory = mailbox_out()
    assert channel.write_by_master(START, b"head") == 0
    assert (channel.is_full, channel.take()) == (False, None)
    assert channel.write_by_master(START + SIZE - 1, b"\x01") == 0x100
    assert status(memory) == 0x09
    assert channel.write_by_master(START, bytes(SIZE)) == -1
    assert channel.take() == b"head" + bytes(11) + b"\x01"
    assert (channel.is_full, channel.take()) == (False, None)
    assert channel.write_by_master(START, bytes(SIZE)) == 0x100


def test_access_opens_with_the_first_octet():
    channel, _ = mailbox_out()
    assert channel.write_by_master(START + 1, bytes(SIZE - 1)) == -1
    assert channel.read_by_master(START, START + SIZE) == -1


def test_sync_channel_mailbox_is_empty_with_its_last_byte():
    channel, memory = mailbox_in()
    assert channel.read_by_master(START, START + SIZE) == -1
    assert channel.put(b"answer")
    assert (status(memory, 1) & 8, memory[START : START + SIZE]) == (8, b"answer" + bytes(10))
    assert not channel.put(b"second")
    assert channel.write_by_master(START, b"x") == -1
    assert channel.read_by_master(START, START + 6) == 0
    assert channel.is_full
    assert channel.read_by_master(START + 6, START + SIZE) == 0x200
    assert not channel.is_full
    assert channel.put(b"second")


def test_sync_channel_discard_empties_the_mailbox():
    channel, _ = mailbox_out()
    channel.write_by_master(START, bytes(SIZE))
    channel.discard()
    assert (channel.is_full, channel.take()) == (False, None)


def test_repeat_request_is_acknowledged_and_no_new_setting():
    channel, memory = mailbox_in()
    memory[0x080E] |= 2
    assert not channel.configure()
    assert (channel.repeat_request, channel.repeat_acknowledge) == (1, 0)
    channel.acknowledge_repeat()
    assert (channel.repeat_acknowledge, memory[0x080F]) == (1, 2)


def test_sync_channel_returns_complete_outputs_once():
    channel, memory = make(mode=0, direction=1, watchdog=1)
    assert (channel.watches, status(memory)) == (True, 0x30)
    assert channel.write_by_master(START, b"first half") == 0
    assert channel.take() is None
    assert channel.write_by_master(START, bytes(range(SIZE))) == 0x100
    assert status(memory) == 0x01
    channel.write_by_master(START, b"\xff\xff")
    assert channel.take() == bytes(range(SIZE))
    assert channel.take() is None
    channel.write_by_master(START, bytes(SIZE))
    assert status(memory) == 0x11


def test_inputs_do_not_change_under_a_reader():
    channel, memory = make(mode=0, direction=0)
    channel.put(b"a" * SIZE)
    assert channel.read_by_master(START, START + 8) == 0
    channel.put(b"b" * SIZE)
    assert memory[START : START + SIZE] == b"a" * SIZE
    assert channel.read_by_master(START + 8, START + SIZE) == 0x100
    assert channel.read_by_master(START, START + SIZE) == 0x100
    assert memory[START : START + SIZE] == b"b" * SIZE


@pytest.mark.parametrize("direction", [0, 1])
def test_slave_locks_the_master_out(direction):
    channel, memory = make(mode=0, direction=direction)
    memory[0x0807] = 1
    assert channel.is_locked
    assert channel.read_by_master(START, START + SIZE) == -1
    assert channel.write_by_master(START, bytes(SIZE)) == -1


def test_stuck_mailbox_is_never_taken():
    channel, _ = mailbox_out()
    channel.is_stuck = True
    channel.write_by_master(START, bytes(SIZE))
    assert channel.take() is None
    channel.is_stuck = False
    assert channel.take() == bytes(SIZE)


def test_area_behind_the_memory_is_cut():
    memory = bytearray(0x1008)
    memory[0x0800:0x0808] = SyncManager(START, SIZE, enable=1).encode()
    assert SyncChannel(memory, 0).length == 8
    memory[0x0800:0x0808] = SyncManager(0x3000, SIZE, enable=1).encode()
    assert SyncChannel(memory, 0).length == 0


def test_sync_channel_new_setting_empties_it():
    channel, memory = mailbox_out()
    channel.write_by_master(START, bytes(SIZE))
    memory[0x0800:0x0808] = SyncManager(START, SIZE // 2, 2, 1, enable=1).encode()
    assert channel.configure()
    assert (channel.length, channel.is_full, channel.take()) == (SIZE // 2, False, None)


class MailboxMachine(RuleBasedStateMachine):
    """Whatever both sides do, every message is taken once and none is overwritten."""

    def __init__(self):
        super().__init__()
        self.channel, _ = mailbox_out()
        self.waiting = None

    @rule(content=st.binary(min_size=SIZE, max_size=SIZE))
    def master_writes(self, content):
        accepted = self.channel.write_by_master(START, content) > 0
        assert accepted == (self.waiting is None)
        if accepted:
            self.waiting = content

    @rule()
    def slave_takes(self):
        assert self.channel.take() == self.waiting
        self.waiting = None

    @invariant()
    def full_says_so(self):
        assert self.channel.is_full == (self.waiting is not None)


TestMailboxMachine = MailboxMachine.TestCase


@pytest.fixture
def memory():
    return bytearray(0x1000)


def test_default_is_a_tenth_of_a_second(memory):
    assert Watchdog(memory).timeout_ns == 100_000_000


def test_runs_out_once_and_counts(memory):
    watchdog = Watchdog(memory)
    assert not watchdog.check(10**12)
    watchdog.feed(1000)
    assert watchdog.deadline_ns == 100_001_000
    assert not watchdog.check(100_000_999)
    assert watchdog.check(100_001_000)
    assert (memory[0x0440], memory[0x0442]) == (0, 1)
    assert not watchdog.check(10**12)
    watchdog.feed(5)
    assert memory[0x0440] == 1


def test_counter_stops_at_its_end(memory):
    watchdog = Watchdog(memory)
    memory[0x0442] = 255
    watchdog.feed(0)
    assert watchdog.check(10**9)
    assert memory[0x0442] == 255


def test_watchdog_is_disabled_by_zero_and_stop(memory):
    watchdog = Watchdog(memory)
    watchdog.feed(0)
    watchdog.stop()
    assert not watchdog.check(10**12)
    memory[0x0420:0x0422] = bytes(2)
    watchdog.configure()
    watchdog.feed(0)
    assert watchdog.deadline_ns is None
