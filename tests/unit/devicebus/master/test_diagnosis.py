from __future__ import annotations

import pytest

from devicebus.master.diagnosis import Fault, clear_counters, diagnose
from devicebus.master.scan import assign_stations
from devicebus.wire.register import Register
from tests.support.busline import Bench, Line, run, segment, slave

STATIONS = (1001, 1002, 1003)


@pytest.fixture
def line():
    line = Line(Bench(), segment(slave("a"), slave("b"), slave("branch", after="a", port=3)))
    run(line, assign_stations(list(enumerate(STATIONS))))
    return line


def count(line, name, register, value):
    (found,) = [each for each in line.segment.slaves if each.device.name == name]
    found.esc.memory[register] = value


def test_diagnose_bus_without_errors(line):
    found = run(line, diagnose(STATIONS))
    assert found.first_fault is None
    assert [(each.station, each.answers, each.state) for each in found.slaves] == [
        (1001, True, "INIT"), (1002, True, "INIT"), (1003, True, "INIT"),
    ]  # fmt: skip
    assert [[port.is_open for port in each.ports] for each in found.slaves] == [
        [True, True, False, True], [True, False, False, False], [True, False, False, False],
    ]  # fmt: skip


def test_states_with_their_reasons(line):
    line.segment.slaves[0].fail(0x1A)
    slave_a = run(line, diagnose(STATIONS)).slaves[0]
    assert (slave_a.state, slave_a.code, slave_a.text) == (
        "INIT+ERROR", 0x1A, "synchronization error",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "register", "fault"),
    [
        ("a", Register.RX_ERROR, Fault(1001, 0, None)),
        ("a", Register.RX_ERROR + 3, Fault(1001, 1, 1003)),
        ("a", Register.LOST_LINK + 3, Fault(1001, 3, 1002)),
        ("a", Register.LOST_LINK + 2, Fault(1001, 2, None)),
        ("b", Register.RX_ERROR + 1, Fault(1003, 0, 1001)),
        ("branch", Register.RX_ERROR, Fault(1002, 0, 1001)),
    ],
)
def test_diagnose_names_the_port_where_errors_start(line, name, register, fault):
    count(line, name, register, 3)
    count(line, "b", Register.FORWARDED_RX_ERROR, 9)
    found = run(line, diagnose(STATIONS))
    assert found.first_fault == fault
    assert sum(port.total for each in found.slaves for port in each.ports) == 3
    assert found.slaves[2].ports[0].forwarded == 9


def test_counters_are_cleared(line):
    count(line, "a", Register.RX_ERROR, 3)
    count(line, "b", Register.LOST_LINK, 3)
    run(line, clear_counters((*STATIONS, 1009)))
    assert run(line, diagnose(STATIONS)).first_fault is None


def test_diagnosis_slave_without_answer(line):
    found = run(line, diagnose((*STATIONS, 1009)))
    assert [each.answers for each in found.slaves] == [True, True, True, False]
    assert found.slaves[3].ports == ()
