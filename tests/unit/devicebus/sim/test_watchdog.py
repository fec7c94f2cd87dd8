"""The process data watchdog in virtual time."""

from __future__ import annotations

import pytest

from devicebus.sim.watchdog import Watchdog


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


def test_zero_switches_it_off_and_stop_ends_it(memory):
    watchdog = Watchdog(memory)
    watchdog.feed(0)
    watchdog.stop()
    assert not watchdog.check(10**12)
    memory[0x0420:0x0422] = bytes(2)
    watchdog.configure()
    watchdog.feed(0)
    assert watchdog.deadline_ns is None
