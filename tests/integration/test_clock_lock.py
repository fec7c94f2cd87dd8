"""Cycle of a running station that follows the reference clock of its bus."""

from __future__ import annotations

import json

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import Plants, wait_until

pytestmark = pytest.mark.net

BUS = """
bus: clocks
slaves:
  - name: first
    kind: digital
    product: 7
    clock: {drift_ppm: 80, start_ns: 123456789}
    inputs: [{name: echo, follows: lamp}]
    outputs: [{name: lamp}]
  - name: second
    kind: digital
    product: 8
    clock: {drift_ppm: -40, needs_sync0: true}
    inputs: [{name: echo, follows: lamp}]
    outputs: [{name: lamp}]
"""
PLANT = f"""
plant: clocks
stations:
  - name: one
    net_id: 5.1.1.1.1.1
    cycle_us: 4000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{own_address(0)}", net_id: 5.1.1.1.2.1}}
      - name: bus0
        kind: bus
        net_id: 5.1.1.1.3.1
        interface: sim://clocks.yaml
        slaves: {{second: {{sync0: {{}}}}}}
"""


def test_cycle_follows_the_clock_of_a_bus_with_sync0(farm: Plants):
    (farm.folder / "clocks.yaml").write_text(BUS)
    appliance = farm.run(farm.write(PLANT))

    def lock() -> dict:
        return appliance.station("one")["ports"][1]["bus"].get("lock", {})

    wait_until(lambda: lock().get("is_locked"))
    found = lock()
    assert found["reference"] == 1001
    assert found["lead_ns"] == 1_200_000
    # The drift between the host and the first slave: 80 ppm, with what a busy machine adds.
    wait_until(lambda: -300_000 < lock()["drift_ppb"] < 100_000)
    shown = " ".join(appliance.command("bus", "diag", "one/bus0").split())
    assert "the clock of slave 1001: offset" in shown
    assert "frames 1.2 ms before SYNC0" in shown
    document = json.loads(appliance.command("bus", "diag", "one/bus0", "--json"))
    assert document["lock"]["reference"] == 1001
    # Without the clock the cycle goes on with the length that it had.
    appliance.command("sim", "fault", "one/bus0", "power", "slave=first")
    wait_until(lambda: not lock()["is_locked"])
    assert appliance.stop()[0] == 0


def test_cycle_follows_the_clock_after_a_changed_cycle(farm: Plants):
    (farm.folder / "clocks.yaml").write_text(BUS)
    file = farm.write(PLANT)
    appliance = farm.run(file)

    def lock() -> dict:
        return appliance.station("one")["ports"][1]["bus"].get("lock", {})

    wait_until(lambda: lock().get("is_locked"))
    farm.write(PLANT.replace("cycle_us: 4000", "cycle_us: 8000"))
    lines = appliance.command("plan", str(file)).splitlines()
    assert "  * bus0 restarts: its slaves go to INIT, and to OP again" in lines
    assert "  * bus0: cycle_us 4000 -> 8000" in lines
    appliance.command("apply", str(file))
    wait_until(lambda: lock().get("is_locked") and lock()["lead_ns"] == 2_400_000)
    assert appliance.stop()[0] == 0
