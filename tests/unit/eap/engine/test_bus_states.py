from __future__ import annotations

import pytest

from devicebus.wire.alstatus import AlState
from eap.engine.bus_mapping import BusStateVariables
from eap.pd.spec import BusSlaveSpec, VariableSpec, Writer
from tests.support.cyclic import image_of, station

NAMES = ("bus0.state", "bus0.a.state", "bus0.b.state")
SLAVES = (BusSlaveSpec("a", 1001, 1, 2), BusSlaveSpec("b", 1002, 1, 2))


class Unit:
    is_absent = False

    def __init__(self, al_state):
        self.al_state = al_state


class Cycle:
    is_full = True


class Master:
    def __init__(self, *units):
        self.slaves = {1001 + number: unit for number, unit in enumerate(units)}
        self.cycle = None
        self.changes = 0


@pytest.fixture
def image():
    states = [VariableSpec(name, "BYTE", Writer.ENGINE) for name in NAMES]
    flag = VariableSpec("bus0.wkc_ok", "BOOL", Writer.ENGINE)
    return image_of(station(variables=(*states, flag)))


def read(image):
    return [image.read(name) for name in (*NAMES, "bus0.wkc_ok")]


def test_the_lowest_state_is_that_of_the_bus(image):
    states = BusStateVariables("bus0", SLAVES, image)
    master = Master(Unit(AlState.OP), Unit(AlState.SAFEOP))
    master.cycle = Cycle()
    states.show(master)
    assert read(image) == [4, 8, 4, True]
    master.slaves[1002].al_state = 0
    master.changes += 1
    master.cycle.is_full = False
    states.show(master)
    assert read(image) == [0, 8, 0, False]


def test_engine_bus_discards_frames_of_earlier_engine(image):
    for name in NAMES:
        image.write(name, 8)
    BusStateVariables("bus0", SLAVES, image).show(Master())
    assert read(image) == [0, 0, 0, False]


def test_engine_bus_runs_undescribed_slaves(image):
    BusStateVariables("bus0", SLAVES[:1], image).show(Master(Unit(AlState.OP), Unit(AlState.INIT)))
    assert read(image)[:3] == [1, 8, 0]


def test_a_station_without_such_variables_is_left_alone():
    bare = image_of(station())
    before = bytes(bare.memory)
    BusStateVariables("bus0", SLAVES, bare).show(Master(Unit(AlState.OP), Unit(AlState.OP)))
    assert bytes(bare.memory) == before
