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


def test_clock_starts_at_its_local_time_and_drifts(memory):
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
    clock.latch(1000, (10, 500, None, None), 10)
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
def test_clock_loop_corrects_drift(drift_ppm):
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


def activate(memory, clock, activation, *, start=1_000, sync0=500, sync1=0, now=0):
    put(memory, Register.DC_START_TIME, start, 8)
    put(memory, Register.DC_SYNC0_CYCLE, sync0, 4)
    put(memory, Register.DC_SYNC1_CYCLE, sync1, 4)
    memory[Register.DC_ACTIVATION] = activation
    clock.activate(now)


def test_clock_register_is_the_time_at_the_reference(memory):
    clock = Clock(memory)
    put(memory, Register.DC_SYSTEM_TIME_DELAY, 100, 4)
    clock.local_time(0)
    clock.refresh(1_000)
    assert get(memory, Register.DC_SYSTEM_TIME, 8) == 900
    assert clock.system_time(1_000) == 1_000
    clock.steer((900).to_bytes(8, "little"), 1_000)
    assert get(memory, Register.DC_SYSTEM_TIME_DIFFERENCE, 4) == 0


def test_clock_sync0_counts_cycles(memory):
    clock = Clock(memory)
    clock.local_time(0)
    assert clock.take_sync0(10**6) == 0
    activate(memory, clock, 3)
    assert clock.sync0_is_active
    assert not clock.sync1_is_active
    assert clock.take_sync0(999) == 0
    assert clock.take_sync0(1_000) == 1
    assert clock.take_sync0(1_000) == 0
    assert clock.take_sync0(2_499) == 2
    memory[Register.DC_ACTIVATION] = 0
    clock.activate(9_000)
    assert clock.take_sync0(10_000) == 0


@pytest.mark.parametrize(("activation", "cycle"), [(1, 500), (2, 500), (3, 0)])
def test_clock_sync0_needs_activation_and_cycle(memory, activation, cycle):
    clock = Clock(memory)
    activate(memory, clock, activation, sync0=cycle)
    assert not clock.sync0_is_active


def test_sync0_that_should_have_begun_never_does(memory):
    clock = Clock(memory, local_start_ns=5_000)
    activate(memory, clock, 3)
    assert not clock.sync0_is_active
    assert memory[Register.DC_ACTIVATION_STATUS] == 4
    assert clock.take_sync0(10**9) == 0


@pytest.mark.parametrize(
    ("sync1", "times"),
    [
        (0, [1_000, 1_500, 2_000]),
        (200, [1_200, 1_700, 2_200]),
        (500, [1_500, 2_500, 3_500]),
        (1_100, [2_100, 3_600, 5_100]),
    ],
)
def test_sync1_follows_sync0(memory, sync1, times):
    clock = Clock(memory)
    clock.local_time(0)
    activate(memory, clock, 7, sync1=sync1)
    assert clock.sync1_is_active
    assert [clock.take_sync1(at - 1 + late) for at in times for late in (0, 1)] == [0, 1] * 3


def test_next_pulses_are_shown(memory):
    clock = Clock(memory)
    clock.local_time(0)
    activate(memory, clock, 7, sync1=200)
    shown = []
    for now in (500, 1_000, 1_100, 1_200, 2_250):
        clock.refresh(now)
        shown.append(
            (
                memory[Register.DC_ACTIVATION_STATUS],
                get(memory, Register.DC_START_TIME, 8),
                get(memory, Register.DC_NEXT_SYNC1, 8),
            )
        )
    assert shown == [
        (3, 1_000, 1_200), (2, 1_500, 1_200), (2, 1_500, 1_200), (0, 1_500, 1_700),
        (0, 2_500, 2_700),
    ]  # fmt: skip
