from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError
from devicebus.master.master import Master
from devicebus.wire.alstatus import AlState
from eap.engine.bus_requests import bring_all, bring_one
from tests.support.busline import MS, Paced, segment, slave


def line_of(target=AlState.OP, count=3):
    line = Paced(Master(), segment(*[slave(f"s{n}") for n in range(count)]))
    line.wait(line.core.bring_up(line.now_ns, target))
    return line


def states(line):
    return [each.state for each in line.segment.slaves]


def test_one_or_all_are_brought_and_kept():
    line = line_of()
    line.wait(bring_one(line.core, 1002, AlState.PREOP, line.now_ns))
    assert states(line) == [AlState.OP, AlState.PREOP, AlState.OP]
    line.wait(bring_all(line.core, AlState.SAFEOP, line.now_ns))
    line.elapse(300 * MS)
    assert states(line) == [AlState.SAFEOP] * 3


def test_without_process_data_all_get_there_or_none():
    line = line_of(AlState.PREOP)
    with pytest.raises(BusError, match="process data of this bus is not laid out"):
        bring_one(line.core, 1002, AlState.OP, line.now_ns)
    line.wait(bring_all(line.core, AlState.OP, line.now_ns))
    assert states(line) == [AlState.OP] * 3


def test_without_slaves_there_is_nothing_to_bring():
    master = Master()
    with pytest.raises(BusError, match="no slave is known"):
        bring_all(master, AlState.OP, 0)
    with pytest.raises(BusError, match="unknown slave 1001"):
        bring_one(master, 1001, AlState.OP, 0)


def test_those_that_fail_are_named():
    line = line_of(AlState.SAFEOP)
    line.segment.slaves[0].refused_states[AlState.OP] = 0x1A
    with pytest.raises(AlStatusError, match="slave 1001: refuses OP"):
        line.wait(bring_all(line.core, AlState.OP, line.now_ns))
    line.wait(bring_all(line.core, AlState.SAFEOP, line.now_ns))
    line.segment.slaves[2].refused_states[AlState.OP] = 0x19
    with pytest.raises(BusError) as caught:
        line.wait(bring_all(line.core, AlState.OP, line.now_ns))
    assert str(caught.value).startswith("2 slaves have failed:\n  s0 (1001): refuses OP")


def test_one_that_is_on_its_way_is_named():
    line = line_of(count=1)
    bring_one(line.core, 1001, AlState.INIT, line.now_ns)
    task = bring_all(line.core, AlState.PREOP, line.now_ns)
    assert "being brought to INIT" in str(task.error)


def test_cancelling_stops_all_of_them():
    line = line_of()
    task = bring_all(line.core, AlState.PREOP, line.now_ns)
    task.cancel()
    line.elapse(5 * MS)
    assert "cancelled" in str(task.error)
    assert not any(unit.is_busy for unit in line.core.slaves.values())
