"""A bus of 200 simulated slaves over a cable while busy loops take the processors: ``EAP_LONG=1``.

Slaves come to OP and stay there, and a file goes through, however late frames are.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, plants, wait_until
from tests.support.simulator import FAR, NEAR, simulator, veth_pair
from tools.bench import buses

pytestmark = [
    pytest.mark.net,
    pytest.mark.root,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not os.environ.get("EAP_LONG"), reason="minutes: for EAP_LONG=1"),
]

LOOPS = 6
SLAVES = 200
CONTENT = random.Random(5).randbytes(200_000)


@contextmanager
def busy_loops() -> Iterator[None]:
    """Take the processors for the length of a block."""
    command = [sys.executable, "-c", "while True: pass"]
    running = [subprocess.Popen(command) for _ in range(LOOPS)]
    try:
        yield
    finally:
        for each in running:
            each.kill()
            each.wait()


@pytest.fixture
def farm() -> Iterator[Plants]:
    with plants() as found:
        yield found


def bus_of(appliance: Appliance) -> dict[str, Any]:
    """Return what status says of the bus; nothing while a busy engine does not say it in time."""
    (port,) = appliance.station(buses.STATION)["ports"]
    return dict(port.get("bus", {}))


def are_all_in_op(appliance: Appliance) -> bool:
    slaves = bus_of(appliance).get("slaves", [])
    return len(slaves) == SLAVES and all(each["state"] == "OP" for each in slaves)


def test_busy_machine_brings_200_slaves_to_op_and_a_file_through(
    farm: Plants, tmp_path: Path
) -> None:
    bus = farm.folder / "bus.yaml"
    bus.write_bytes(buses.encode(buses.bus(SLAVES, 1400)))
    plant = farm.folder / "plant.yaml"
    plant.write_bytes(buses.encode(buses.plant(f"ethernet://{NEAR}", 4000, bus="bus.yaml")))
    source = tmp_path / "file.bin"
    source.write_bytes(CONTENT)
    with ExitStack() as stack:
        stack.enter_context(veth_pair())
        appliance = farm.run(plant)
        stack.enter_context(busy_loops())
        segment = stack.enter_context(simulator(bus, f"ethernet://{FAR}"))
        os.sched_setscheduler(segment.pid, os.SCHED_OTHER, os.sched_param(0))
        seconds = wait_until(lambda: are_all_in_op(appliance), 300)
        print(f"{SLAVES} slaves in OP after {seconds:.1f} s beside {LOOPS} busy loops")
        words = ("bus", "foe", "put", f"{buses.STATION}/{buses.PORT}", "1001", str(source))
        done = json.loads(appliance.command(*words, buses.FILE, "--json"))
        assert done["sha256"] == hashlib.sha256(CONTENT).hexdigest()
        wait_until(lambda: bus_of(appliance).get("frames", {}).get("late", 0) > 0)
        wait_until(lambda: are_all_in_op(appliance))
