"""Registers of slaves in memory, and a scan."""

from __future__ import annotations

from collections.abc import Sequence

from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import DatagramReply, DatagramRequest
from eap.services.device.master_registers import (
    LOOPS,
    SlaveRegisters,
    detect_slaves,
    read_registers,
)
from tests.support.fakeengine import FakeBus
from tests.support.loopbus import LoopBus


def test_registers_of_slaves_that_do_not_answer_are_left_out() -> None:
    bus = FakeBus(LoopBus("io"))
    stations = [1001, 1002, 1003, 1004, 1009]
    seen = bus.finish(bus.master.run(read_registers(stations), bus.line.now_ns))
    assert list(seen) == [1001, 1002, 1003, 1004]
    assert {each.al.state for each in seen.values()} == {AlState.PREOP}
    assert seen[1001].errors == (0, 0, 0, 0)
    assert seen[1001].dl_word
    assert SlaveRegisters().errors == (0, 0, 0, 0)
    assert LOOPS == 0x0101


def test_registers_of_many_slaves_are_read_in_few_steps() -> None:
    stations = range(1001, 1041)
    look, steps = read_registers(stations), 0

    def answered(asked: Sequence[DatagramRequest]) -> tuple[list[DatagramReply], int]:
        nonlocal steps
        steps += 1
        return [DatagramReply(access.data, 1) for access in asked], 0

    def run() -> dict[int, SlaveRegisters]:
        asked = next(look)
        while True:
            try:
                asked = look.send(answered(asked))
            except StopIteration as end:
                return end.value

    assert list(run()) == list(stations)
    assert steps == 3


def test_scan_finds_all_slaves() -> None:
    bus = FakeBus(LoopBus("io"))
    found = bus.finish(bus.master.run(detect_slaves(), bus.line.now_ns))
    assert [each.station for each in found] == [1001, 1002, 1003, 1004]
    assert all(each.identity.vendor for each in found)
