"""A bus that restarts with other settings while its station runs."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from devicebus.errors import BusError
from devicebus.wire.alstatus import AlState
from eap.engine.bus_settings import master_settings
from eap.pd.spec import BusTarget
from tests.support.cyclic import MS
from tests.support.enginebus import BusRig


@pytest.fixture
def rig(tmp_path):
    made = BusRig(tmp_path).start()
    made.wait_op()
    return made


def restart(rig, **changes):
    """Restart the bus with other settings of its port."""
    port = rig.station.ports[1]
    port = replace(port, bus=replace(port.bus, **changes))
    settings = master_settings(port, rig.station.cycle_us)
    parts = rig.bus.prepare_restart(port, settings, rig.image, rig.memory_of)
    return rig.bus.restart(parts, rig.now_ns)


def renamed(rig, station, name):
    """Return the slaves, one of them with another name."""
    slaves = rig.station.ports[1].bus.slaves
    return tuple(replace(s, name=name) if s.station == station else s for s in slaves)


def test_slaves_go_to_init_and_to_the_new_target(rig):
    before = rig.bus.master
    slave = rig.wire.segment.segment.slaves[1]
    assert restart(rig, target=BusTarget.SAFEOP) is before
    assert (rig.bus.is_up, rig.bus.fault) == (False, "it restarts with other settings")
    states = []
    while not rig.bus.is_up or rig.value("state") != AlState.SAFEOP:
        rig.step(rig.now_ns + MS)
        if slave.state not in states[-1:]:
            states.append(slave.state)
    assert states[-3:] == [AlState.INIT, AlState.PREOP, AlState.SAFEOP]
    assert rig.bus.fault == ""
    rig.run(100 * MS)
    assert slave.state is AlState.SAFEOP


def test_inputs_keep_their_values_until_slaves_send_again(rig):
    rig.run(2 * MS)
    assert rig.value("level.height") == -7
    restart(rig, frame_retries=2)
    seen = set()
    while not rig.bus.is_up or rig.value("state") != AlState.OP:
        rig.step(rig.now_ns + MS)
        seen.add(rig.value("level.height"))
    assert seen == {-7}
    assert rig.value("wkc_ok") is True


def test_requests_under_way_fail_with_the_reason(rig):
    task = rig.bus.master.request_state(1002, AlState.PREOP, rig.now_ns)
    rig.bus.keep(task, rig.now_ns)
    restart(rig, frame_retries=2)
    with pytest.raises(BusError, match="it restarts with other settings"):
        task.result()
    assert rig.bus.tasks == set()


def test_faults_of_other_slaves_are_forgotten(rig):
    for position in (1, 2):
        rig.wire.segment.segment.slaves[position].fail(0x1B)
    rig.wait(lambda: rig.bus.faults.counts(1002).departures)
    rig.wait(lambda: rig.bus.faults.counts(1003).departures)
    restart(rig, slaves=renamed(rig, 1003, "tank"))
    assert rig.bus.faults.counts(1002).departures == 1
    assert rig.bus.faults.counts(1003).departures == 0
    assert rig.bus.faults.last(1003).text == ""
