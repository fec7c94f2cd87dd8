"""Killed processes as the others see it: how long nothing came, and whether all counters agree.

One appliance runs the sender and a receiver, another one a second receiver; a witness that is none
of ours keeps every frame of the wire.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.listener import Listener, listen_to_group
from tests.support.machine import slowness

pytestmark = pytest.mark.net
IS_ABOUT_PROCESSES = True

GROUP, SENDER = "239.9.4.1", "127.9.4.1"
CYCLE_NS = 10_000_000
PROCESSES = ("engine", "services")
PLANT = f"""\
plant: kill
defaults: {{cycle_us: {CYCLE_NS // 1000}}}
x-receiver: &receiver
  subscribe:
    - {{name: sender, port: eap0, from: sender/state, timeout_ms: 200}}
stations:
  - name: sender
    net_id: 127.9.4.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{SENDER}", net_id: 127.9.4.1.2.1}}
    variables: {{ticks: UDINT}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: out, port: eap0, to: {GROUP}}}
    publish:
      - {{name: state, frame: out, id: 1, variables: [ticks]}}
  - <<: *receiver
    name: near
    net_id: 127.9.4.2.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://127.9.4.2", net_id: 127.9.4.2.2.1}}]
  - <<: *receiver
    name: far
    net_id: 127.9.4.3.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://127.9.4.3", net_id: 127.9.4.3.2.1}}]
"""


@pytest.fixture
def witness() -> Iterator[Listener]:
    with listen_to_group(GROUP, SENDER) as listener:
        yield listener


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> tuple[Appliance, Appliance]:
    plant = module_farm.write(PLANT)
    other = module_farm.run(plant, "--station", "far")
    own = module_farm.run(plant, "--station", "sender", "--station", "near")
    return own, other


@pytest.fixture
def both(shared: tuple[Appliance, Appliance], witness: Listener) -> tuple[Appliance, Appliance]:
    own, other = shared
    wait_until(lambda: len(witness.seen()) > 20)
    wait_until(lambda: own.rx("near", "sender")["received"] > 20)
    wait_until(lambda: other.rx("far", "sender")["received"] > 20)
    return own, other


def stale(appliance: Appliance, station: str) -> int:
    return int(appliance.station(station)["discarded"].get("stale", 0))


def test_a_killed_engine_leaves_a_gap_of_its_true_length(
    both: tuple[Appliance, Appliance], witness: Listener
) -> None:
    own, other = both
    old, restarts = own.pid("engine"), own.status()["processes"]["engine"]["restarts"]
    before = stale(own, "near")
    lost = own.rx("near", "sender")["lost"], other.rx("far", "sender")["lost"]
    busy = slowness()
    count = len(witness.seen())
    os.kill(old, signal.SIGKILL)
    took_s = wait_until(lambda: len(witness.seen()) > count + 3)
    wait_until(lambda: len(witness.seen()) > count + 20)

    steps = [b - a for a, b in itertools.pairwise(witness.cycles())]
    pauses = [b.at_ns - a.at_ns for a, b in itertools.pairwise(witness.seen())]
    (gap,) = (index for index, step in enumerate(steps) if step != 1)
    missing = steps[gap] - 1
    assert missing > 0
    limit_s = 1.0 * max(busy, slowness())
    assert pauses[gap] < limit_s * 1e9
    assert took_s < limit_s
    assert abs(steps[gap] * CYCLE_NS - pauses[gap]) < 3 * CYCLE_NS
    assert other.rx("far", "sender")["lost"] == lost[1] + missing
    # What waited at the killed engine is not taken by the new one: lost, and counted as stale.
    near = own.rx("near", "sender")
    assert near["lost"] == lost[0] + missing + stale(own, "near") - before
    for rx in (near, other.rx("far", "sender")):
        assert (rx["duplicated"], rx["reordered"], rx["state"]) == (0, 0, "running")
    after = own.status()
    assert after["processes"]["engine"]["restarts"] == restarts + 1
    assert after["processes"]["engine"]["pid"] != old
    assert [station["state"] for station in after["stations"]] == ["OP", "OP"]


def test_killed_services_leave_no_gap(both: tuple[Appliance, Appliance], witness: Listener) -> None:
    own, other = both
    before = own.status()["processes"]
    troubles_before = troubles(own.rx("near", "sender")), troubles(other.rx("far", "sender"))
    for number in range(1, 4):
        os.kill(own.pid("services"), signal.SIGKILL)
        expected = before["services"]["restarts"] + number
        wait_until(lambda: own.status()["processes"]["services"]["restarts"] == expected)  # noqa: B023
    count = len(witness.seen())
    wait_until(lambda: len(witness.seen()) > count + 20)
    cycles = witness.cycles()
    assert cycles == list(range(cycles[0], cycles[0] + len(cycles)))
    assert troubles(own.rx("near", "sender")) == troubles_before[0]
    assert troubles(other.rx("far", "sender")) == troubles_before[1]
    processes = own.status()["processes"]
    assert processes["engine"]["pid"] == before["engine"]["pid"]
    restarts = [processes[name]["restarts"] - before[name]["restarts"] for name in PROCESSES]
    assert restarts == [0, 3]


def test_an_engine_that_does_not_get_up_ends_the_start_in_one_line(farm: Plants) -> None:
    appliance = farm.start(farm.write(PLANT.replace("9.4.", "9.43.")))

    def pid_of(name: str) -> int:
        infos = [
            json.loads(each.read_text()) for each in appliance.runtime.glob("*/appliance.json")
        ]
        return int(infos[0][name]["pid"]) if infos else 0

    wait_until(lambda: pid_of("engine"))
    engine = pid_of("engine")
    os.kill(engine, signal.SIGSTOP)
    wait_until(lambda: pid_of("services"))
    states: list[str] = []

    def is_asleep() -> bool:
        states.append(state_of(pid_of("services")))
        return states[-10:] == ["S"] * 10

    wait_until(is_asleep)  # services wait for the images of the engine
    start = time.monotonic()
    os.kill(engine, signal.SIGKILL)
    assert appliance.finish() == (
        1,
        "",
        "supervisor: engine was killed by SIGKILL while starting\n",
    )
    assert time.monotonic() - start < 0.9 * slowness()


def state_of(pid: int) -> str:
    """Return the letter of a process's state."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
