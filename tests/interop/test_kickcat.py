"""KickCAT as the master of our simulated slaves.

It is asked for no object that needs segments: KickCAT 2.5 takes the bit that marks the last segment
(ETG.1000.6) for one that shows details will follow, and looks for the data four octets too far on.
Later ones read segments, but not the data that comes with the first response.  Nor is it asked for
what there is not: 2.5 takes no abort for an answer.  SOEM does all of this (test_pysoem.py).
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.simulator import NEAR, simulator, veth_pair
from tests.support.terminals import sizes_of, write_bus

kickcat = pytest.importorskip("kickcat", reason="needs kickcat: pip install kickcat")

pytestmark = [pytest.mark.net, pytest.mark.root]

ROOT = Path(__file__).parents[2]
BUS = """
bus: interop
slaves:
  - name: island
    kind: generic
    vendor: 0x1234
    inputs: [{name: level, type: UINT, follows: speed}]
    outputs: [{name: speed, type: UINT}]
    objects: [{index: 0x8001, name: Curve, type: BLOCK(240)}]
  - {name: drive, kind: drive}
"""
UNSEGMENTED = 256 - 16
"""Octets of the largest object that one message of a mailbox of 256 octets takes."""
FRAME_S, ANSWER_S, STATE_S = 0.02, 1.0, 5.0
ATTEMPTS = 5  # KickCAT waits out FRAME_S for every frame, so it is short, and a busy machine late
CYCLES = 20


@pytest.fixture
def island_bus(tmp_path):
    path = tmp_path / "bus.yaml"
    path.write_text(BUS)
    return path


def run_alone(path, body):
    """Run *body* in a process of its own; again if KickCAT 2.5 crashes, as on late frames.

    Return what it prints last.
    """
    with veth_pair(), simulator(path):
        for _ in range(ATTEMPTS):
            command = [sys.executable, "-m", "tests.interop.test_kickcat", body.__name__]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
            if done.returncode != -signal.SIGSEGV:
                break
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


def open_bus():
    link = kickcat.create_link(NEAR, "")
    link.set_timeout(FRAME_S)
    found = kickcat.Bus(link)
    patient(lambda: found.init(0.1))
    return found


def patient(call):
    for _ in range(ATTEMPTS - 1):
        try:
            return call()
        except (RuntimeError, kickcat.ErrorAL):  # the latter where it lost frames of a state
            continue
    return call()


def operate(bus):
    bus.create_mapping()
    bus.request_state(kickcat.State.SAFE_OP)
    bus.wait_for_state(kickcat.State.SAFE_OP, STATE_S)
    for slave in bus.slaves():
        slave.set_output_bytes(bytes(slave.output_size))
    bus.process_data_no_check()
    bus.request_state(kickcat.State.OPERATIONAL)
    bus.wait_for_state(kickcat.State.OPERATIONAL, STATE_S, bus.process_data_no_check)


def scan_and_sdo(bus):
    slaves = bus.slaves()
    assert len(slaves) == 2
    octets = bus.read_sdo(slaves[0], 0x1018, 1, kickcat.Access.PARTIAL, 4, ANSWER_S)
    assert octets == (0x1234).to_bytes(4, "little")
    curve = bus.read_sdo(slaves[0], 0x8001, 0, kickcat.Access.PARTIAL, UNSEGMENTED, ANSWER_S)
    assert curve == bytes(UNSEGMENTED)
    whole = bus.read_sdo(slaves[0], 0x1018, 0, kickcat.Access.COMPLETE, 18, ANSWER_S)
    assert whole[:6] == bytes((4, 0)) + (0x1234).to_bytes(4, "little")
    assert bus.read_object_description(slaves[0], 0x8001)[0] == "Curve"


def process_data_in_op(bus):
    operate(bus)
    island = bus.slaves()[0]
    assert bus.get_state(island) == kickcat.State.OPERATIONAL
    for number in range(CYCLES):
        island.set_output_bytes(number.to_bytes(2, "little"))
        patient(bus.process_data)
    patient(bus.process_data)
    assert island.input_data == (CYCLES - 1).to_bytes(2, "little")
    assert [bus.get_state(each) for each in bus.slaves()] == [kickcat.State.OPERATIONAL] * 2


def print_sizes_in_op(bus):
    operate(bus)
    assert {bus.get_state(each) for each in bus.slaves()} == {kickcat.State.OPERATIONAL}
    print(json.dumps([(each.output_size, each.input_size) for each in bus.slaves()]))


def test_scan_and_sdo(island_bus):
    run_alone(island_bus, scan_and_sdo)


def test_process_data_in_op(island_bus):
    run_alone(island_bus, process_data_in_op)


@pytest.mark.parametrize("name", ["io", "terminals"])
def test_kickcat_exchanges_as_many_bytes_of_each_slave_as_our_master(tmp_path, name):
    path = write_bus(tmp_path) if name == "terminals" else ROOT / f"config/buses/{name}.yaml"
    sizes = json.loads(run_alone(path, print_sizes_in_op))
    assert [tuple(each) for each in sizes] == sizes_of(path)


if __name__ == "__main__":
    globals()[sys.argv[1]](open_bus())
