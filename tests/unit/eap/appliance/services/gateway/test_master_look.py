"""Registers of slaves in memory."""

from __future__ import annotations

from devicebus.wire.alstatus import AlState
from eap.appliance.services.gateway.master_look import LOOPS, Seen, detect, look_at
from tests.support.fakeengine import FakeBus
from tests.support.loopbus import LoopBus


def test_slaves_are_looked_at_and_who_does_not_answer_is_left_out() -> None:
    bus = FakeBus(LoopBus("io"))
    stations = [1001, 1002, 1003, 1004, 1009]
    seen = bus.finish(bus.master.run(look_at(stations), bus.line.now_ns))
    assert list(seen) == [1001, 1002, 1003, 1004]
    assert {each.al.state for each in seen.values()} == {AlState.PREOP}
    assert seen[1001].errors == (0, 0, 0, 0)
    assert seen[1001].dl_word
    assert Seen().errors == (0, 0, 0, 0)
    assert LOOPS == 0x0101


def test_a_scan_finds_who_is_there() -> None:
    bus = FakeBus(LoopBus("io"))
    found = bus.finish(bus.master.run(detect(), bus.line.now_ns))
    assert [each.station for each in found] == [1001, 1002, 1003, 1004]
    assert all(each.identity.vendor for each in found)
