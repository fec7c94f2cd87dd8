"""The state machine of CiA 402: its table, and words from the standard."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim.devices.cia402 import (
    TRANSITIONS,
    DriveCommand,
    DriveState,
    DriveStateMachine,
    command_of,
)


@pytest.mark.parametrize(
    ("word", "command"),
    [
        (0x0000, DriveCommand.DISABLE_VOLTAGE), (0x000D, DriveCommand.DISABLE_VOLTAGE),
        (0x0002, DriveCommand.QUICK_STOP), (0x000B, DriveCommand.QUICK_STOP),
        (0x0006, DriveCommand.SHUTDOWN), (0x000E, DriveCommand.SHUTDOWN),
        (0x0007, DriveCommand.SWITCH_ON), (0x000F, DriveCommand.ENABLE),
        (0x010F, DriveCommand.ENABLE),
    ],
)  # fmt: skip
def test_control_word(word, command):
    assert command_of(word) is command


def test_way_to_enabled_and_its_status_words():
    machine = DriveStateMachine()
    seen = [machine.status_word & 0x6F]
    for word in (0x06, 0x07, 0x0F):
        machine.control(word)
        seen.append(machine.status_word & 0x6F)
    assert seen == [0x40, 0x21, 0x23, 0x27]
    assert machine.is_enabled
    machine.control(0x02)
    assert machine.state is DriveState.QUICK_STOP_ACTIVE
    machine.control(0x0F)
    assert machine.is_enabled
    machine.control(0x00)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_enable_alone_does_not_switch_on():
    machine = DriveStateMachine()
    machine.control(0x0F)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_fault_is_left_by_the_edge_only():
    machine = DriveStateMachine()
    machine.control(0x80)
    machine.process(DriveCommand.FAULT)
    for word in (0x80, 0x06, 0x0F):
        machine.control(word)
        assert machine.state is DriveState.FAULT
    machine.control(0x8F)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


@given(st.lists(st.integers(0, 0xFFFF), max_size=20))
def test_any_words_lead_to_a_known_state(words):
    machine = DriveStateMachine()
    for word in words:
        before = machine.state
        machine.control(word)
        assert machine.state is before or machine.state in TRANSITIONS.values()
        assert machine.status_word & 0x0210 == 0x0210
