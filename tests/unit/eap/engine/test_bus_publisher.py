"""Changes of a bus as messages: each is sent once, and none is forgotten."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import asdict

from devicebus.wire.alstatus import AlState
from eap.engine.bus_report import BusPublisher, report_bus
from eap.runtime.engine_messages import BusChange, SlaveDescription
from tests.support.cyclic import MS
from tests.support.enginebus import BusRig


class Receiver:
    """Reports that services has decoded."""

    def __init__(self) -> None:
        self.messages: list[BusChange] = []
        self.slaves: dict[int, SlaveDescription] = {}
        self.is_full = False

    def take(self, change: BusChange) -> bool:
        if self.is_full:
            return False
        self.messages.append(change)
        known = self.slaves | {each.station: each for each in change.slaves}
        self.slaves = {station: known[station] for station in change.stations}
        return True

    def stations(self) -> list[list[int]]:
        """Return the slaves of each message, and forget the messages."""
        messages, self.messages = self.messages, []
        return [[slave.station for slave in each.slaves] for each in messages]


@pytest.fixture
def rig(tmp_path):
    made = BusRig(tmp_path).start()
    made.wait_op()
    made.run(300 * MS)
    return made


@pytest.fixture
def receiver():
    return Receiver()


@pytest.fixture
def publisher(rig, receiver):
    made = BusPublisher(0, rig.bus, receiver.take)
    made.flush()
    return made


def truth(rig: BusRig) -> dict[int, SlaveDescription]:
    """Return all descriptions as an explicit report has them."""
    names = SlaveDescription.__struct_fields__
    rig.bus.faults.handle_events(rig.bus.master)
    return {
        slave.station: SlaveDescription(**{name: asdict(slave)[name] for name in names})
        for slave in report_bus(rig.bus, rig.now_ns).slaves
    }


def test_bus_publisher_sends_all_slaves_first_then_changes_only(rig, receiver, publisher):
    assert receiver.stations() == [[1001, 1002, 1003]]
    assert receiver.slaves == truth(rig)
    for _ in range(50):
        rig.run(20 * MS)
        publisher.flush()
    assert not receiver.messages


def test_publisher_sends_only_the_slave_that_has_changed(rig, receiver, publisher):
    receiver.stations()
    rig.bus.keep(rig.bus.master.request_state(1002, AlState.PREOP, rig.now_ns), rig.now_ns)
    rig.wait(lambda: rig.value("io.state") == AlState.PREOP)
    publisher.flush()
    assert receiver.stations() == [[1002]]
    assert receiver.slaves[1002].to_slave
    assert receiver.slaves == truth(rig)


def test_bus_publisher_repeats_unsent_changes(rig, receiver, publisher):
    receiver.stations()
    receiver.is_full = True
    rig.fault(kind="power", slave="level", for_ms=300)
    rig.wait(lambda: rig.value("level.state") == 0)
    publisher.flush()
    receiver.is_full = False
    publisher.flush()
    assert receiver.stations() == [[1003]]
    assert receiver.slaves[1003].fault == "it does not answer"
    assert receiver.slaves[1003].losses == 1


def test_publisher_sends_all_slaves_to_another_receiver(rig, receiver, publisher):
    receiver.stations()
    publisher.reset()
    publisher.flush()
    assert receiver.stations() == [[1001, 1002, 1003]]


def test_publisher_sends_expected_slaves_of_a_master_that_was_replaced(rig, receiver, publisher):
    rig.bus.master.is_quiet = None
    rig.run(2 * MS)
    publisher.flush()
    assert "the master has failed" in receiver.messages[-1].fault
    assert not receiver.messages[-1].is_up
    assert receiver.slaves == truth(rig)
    rig.wait(lambda: rig.bus.is_up)
    publisher.flush()
    assert receiver.messages[-1].is_up
    assert receiver.slaves == truth(rig)


@pytest.mark.parametrize("seed", range(4))
def test_publisher_forgets_no_change_whatever_happens_on_the_bus(tmp_path, seed):
    """Faults and requests at random; after each message services has what a report shows."""
    pick = random.Random(seed)
    rig, receiver = BusRig(tmp_path, cycle_us=4000).start(), Receiver()
    publisher = BusPublisher(0, rig.bus, receiver.take)
    names, count = ["coupler", "io", "level"], 0
    for _ in range(60):
        match pick.randrange(6):
            case 0:
                rig.fault(kind="power", slave=pick.choice(names), for_ms=pick.randrange(1, 400))
            case 1:
                rig.fault(kind="al-error", slave=pick.choice(names), code=0x1B, for_ms=50)
            case 2:
                rig.wire.is_deaf = not rig.wire.is_deaf
            case 3 if units := list(rig.bus.master.slaves.values()):
                unit = pick.choice(units)
                if not unit.is_busy:
                    state = pick.choice((AlState.INIT, AlState.PREOP))
                    rig.bus.keep(
                        rig.bus.master.request_state(unit.station, state, rig.now_ns), rig.now_ns
                    )
            case 4:
                rig.wire.is_deaf = False
        for _ in range(pick.randrange(60)):
            rig.run(pick.choice((1, 1, 1, 20)) * MS)
            receiver.is_full = not pick.randrange(4)
            before = len(receiver.messages)
            publisher.flush()
            if not receiver.is_full:
                assert receiver.slaves == truth(rig)
                assert (rig.bus.is_up, rig.bus.fault) == (
                    receiver.messages[-1].is_up,
                    receiver.messages[-1].fault,
                )
            count += len(receiver.messages) > before
    assert count > 10
