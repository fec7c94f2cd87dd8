"""Distributed clocks: local time, the loop that follows the reference, SYNC0."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim.clock import Clock
from devicebus.wire.register import Register


@pytest.fixture
def memory():
    return bytearray(0x1000)


def put(memory, at, value, size):
    memory[at : at + size] = value.to_bytes(size, "little", signed=value < 0)


def get(memory, at, size):
    return int.from_bytes(memory[at : at + size], "little")


def test_clock_starts_where_it_was_told_and_drifts(memory):
    clock = Clock(memory, drift_ppm=100, local_start_ns=5)
    assert clock.local_time(1_000) == 5
    assert clock.local_time(1_000_001_000) == 1_000_100_005
    clock.set_drift(0, 1_000_001_000)
    assert clock.local_time(2_000_001_000) == 2_000_100_005


def test_system_time_is_local_time_and_offset(memory):
    clock = Clock(memory)
    put(memory, Register.DC_SYSTEM_TIME_OFFSET, 10**18, 8)
    assert clock.system_time(0) == 10**18
    clock.refresh(7)
    assert get(memory, Register.DC_SYSTEM_TIME, 8) == 10**18 + 7
    put(memory, Register.DC_SYSTEM_TIME_OFFSET, -5, 8)
    assert clock.system_time(7) == 2


def test_latch_notes_the_ports_that_a_frame_passed(memory):
    clock = Clock(memory, local_start_ns=1 << 32)
    put(memory, Register.DC_RECEIVE_TIME + 12, 0xAAAA, 4)
    clock.local_time(0)
    clock.latch(1000, (10, 500, None, None))
    assert [get(memory, 0x0900 + 4 * n, 4) for n in range(4)] == [1010, 1500, 0, 0xAAAA]
    assert get(memory, Register.DC_RECEIVE_TIME_ECAT, 8) == (1 << 32) + 1010


def test_difference_is_sign_and_magnitude(memory):
    clock = Clock(memory)
    put(memory, Register.DC_SYSTEM_TIME_DELAY, 100, 4)
    clock.steer((900).to_bytes(8, "little"), 0)
    assert get(memory, Register.DC_SYSTEM_TIME_DIFFERENCE, 4) == 1000 | 1 << 31
    put(memory, Register.DC_SYSTEM_TIME_OFFSET, 3000, 8)
    clock.steer((900).to_bytes(4, "little"), 0)
    assert get(memory, Register.DC_SYSTEM_TIME_DIFFERENCE, 4) == 2000


@given(st.integers(-200, 200))
def test_loop_takes_out_drift(drift_ppm):
    memory = bytearray(0x1000)
    clock = Clock(memory, drift_ppm=drift_ppm)
    clock.local_time(0)
    for cycle in range(4000):
        now = 1_000_000 * cycle
        clock.steer(now.to_bytes(8, "little"), now)
    assert get(memory, Register.DC_SYSTEM_TIME_DIFFERENCE, 4) & 0x7FFF_FFFF < 20


def test_large_error_is_taken_out_without_a_wrong_rate(memory):
    clock = Clock(memory, local_start_ns=1_000_000_000)
    clock.local_time(0)
    for cycle in range(400):
        now = 1_000_000 * cycle
        clock.steer(now.to_bytes(8, "little"), now)
    assert get(memory, Register.DC_SYSTEM_TIME_DIFFERENCE, 4) & 0x7FFF_FFFF < 20_000


def test_new_parameters_restart_the_loop(memory):
    clock = Clock(memory)
    clock.local_time(0)
    clock.steer(bytes(8), 1000)
    clock.restart_loop()
    clock.steer(bytes(8), 2000)
    assert clock.local_time(2000) == 2000


def test_sync0_counts_cycles_since_its_start(memory):
    clock = Clock(memory)
    clock.local_time(0)
    assert clock.take_sync0(10**6) == 0
    put(memory, Register.DC_START_TIME, 1_000, 8)
    put(memory, Register.DC_SYNC0_CYCLE, 500, 4)
    memory[Register.DC_ACTIVATION] = 3
    assert clock.sync0_is_active
    assert clock.take_sync0(999) == 0
    assert clock.take_sync0(1_000) == 1
    assert clock.take_sync0(1_000) == 0
    assert clock.take_sync0(2_499) == 2
    memory[Register.DC_ACTIVATION] = 0
    assert clock.take_sync0(10_000) == 0


@pytest.mark.parametrize(("activation", "cycle"), [(1, 500), (2, 500), (3, 0)])
def test_sync0_needs_both_bits_and_a_cycle(memory, activation, cycle):
    put(memory, Register.DC_SYNC0_CYCLE, cycle, 4)
    memory[Register.DC_ACTIVATION] = activation
    assert not Clock(memory).sync0_is_active
