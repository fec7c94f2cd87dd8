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

import pytest

from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.listener import Listener, listen_to_group
from tests.support.machine import slowness

pytestmark = pytest.mark.net

GROUP, SENDER = "239.9.4.1", "127.9.4.1"
CYCLE_NS = 10_000_000
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


@pytest.fixture
def both(farm: Plants, witness: Listener) -> tuple[Appliance, Appliance]:
    plant = farm.write(PLANT)
    other = farm.run(plant, "--station", "far")
    own = farm.run(plant, "--station", "sender", "--station", "near")
    wait_until(lambda: own.rx("near", "sender")["received"] > 20)
    wait_until(lambda: other.rx("far", "sender")["received"] > 20)
    return own, other


def stale(appliance: Appliance, station: str) -> int:
    return int(appliance.station(station)["discarded"].get("stale", 0))


@pytest.mark.quiet
def test_a_killed_engine_leaves_a_gap_of_its_true_length(
    both: tuple[Appliance, Appliance], witness: Listener
) -> None:
    own, other = both
    old = own.pid("engine")
    before = stale(own, "near")
    count = len(witness.seen())
    os.kill(old, signal.SIGKILL)
    took_s = wait_until(lambda: len(witness.seen()) > count + 3)
    wait_until(lambda: len(witness.seen()) > count + 20)

    steps = [b - a for a, b in itertools.pairwise(witness.cycles())]
    pauses = [b.at_ns - a.at_ns for a, b in itertools.pairwise(witness.seen())]
    (gap,) = (index for index, step in enumerate(steps) if step != 1)
    missing = steps[gap] - 1
    assert missing > 0
    limit_s = 1.0 * slowness()
    assert pauses[gap] < limit_s * 1e9
    assert took_s < limit_s
    assert abs(steps[gap] * CYCLE_NS - pauses[gap]) < 3 * CYCLE_NS
    assert other.rx("far", "sender")["lost"] == missing
    # What waited at the killed engine is not taken by the new one: lost, and counted as stale.
    near = own.rx("near", "sender")
    assert near["lost"] == missing + stale(own, "near") - before
    for rx in (near, other.rx("far", "sender")):
        assert (rx["duplicated"], rx["reordered"], rx["state"]) == (0, 0, "running")
    after = own.status()
    assert after["processes"]["engine"]["restarts"] == 1
    assert after["processes"]["engine"]["pid"] != old
    assert [station["state"] for station in after["stations"]] == ["OP", "OP"]


def test_killed_services_leave_no_gap(both: tuple[Appliance, Appliance], witness: Listener) -> None:
    own, other = both
    engine = own.pid("engine")
    for _ in range(3):
        os.kill(own.pid("services"), signal.SIGKILL)
        time.sleep(0.3)
    count = len(witness.seen())
    wait_until(lambda: len(witness.seen()) > count + 20)
    cycles = witness.cycles()
    assert cycles == list(range(cycles[0], cycles[0] + len(cycles)))
    assert troubles(own.rx("near", "sender")) == (0, 0, 0)
    assert troubles(other.rx("far", "sender")) == (0, 0, 0)
    processes = own.status()["processes"]
    assert processes["engine"]["pid"] == engine
    assert (processes["engine"]["restarts"], processes["services"]["restarts"]) == (0, 3)


@pytest.mark.quiet
def test_an_engine_that_does_not_get_up_ends_the_start_in_one_line(farm: Plants) -> None:
    appliance = farm.start(farm.write(PLANT))
    engine = 0
    deadline = time.monotonic() + 10
    while not engine:
        assert time.monotonic() < deadline, "no engine was started"
        for info in appliance.runtime.glob("*/appliance.json"):
            engine = json.loads(info.read_text())["engine"]["pid"]
    os.kill(engine, signal.SIGSTOP)
    time.sleep(0.5)  # services wait for its images meanwhile
    start = time.monotonic()
    os.kill(engine, signal.SIGKILL)
    assert appliance.finish() == (
        1,
        "",
        "supervisor: engine was killed by SIGKILL while starting\n",
    )
    assert time.monotonic() - start < 0.9
