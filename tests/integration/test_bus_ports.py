"""Buses of a running plant: their slaves get to OP, and back there whatever dies."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import (
    Appliance,
    Plants,
    SharedAppliance,
    run_eapctl,
    wait_until,
)
from tests.support.machine import slowness
from tests.support.simulator import NEAR, simulator, veth_pair

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
OP = 8
STATION, SLAVES, REMOTE_STATION = (own_address(number) for number in range(3))
PLANT = f"""
plant: buses
stations:
  - name: one
    net_id: 5.1.1.1.1.1
    cycle_us: 5000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{STATION}", net_id: 5.1.1.1.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://coe.yaml", net_id: 5.1.1.1.3.1}}
      - {{name: bus1, kind: bus, interface: "sim://io.yaml", net_id: 5.1.1.1.3.2}}
    links:
      - {{from: bus1.inputs.in1, to: bus0.buttons.lamp}}
"""
REMOTE = f"""
plant: remote
stations:
  - name: one
    net_id: 5.1.1.1.1.1
    cycle_us: 5000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{REMOTE_STATION}", net_id: 5.1.1.1.2.1}}
      - name: bus0
        kind: bus
        interface: udp://{SLAVES}
        bus: coe.yaml
        net_id: 5.1.1.1.3.1
"""


@pytest.fixture
def folder(farm: Plants) -> Path:
    return with_buses(farm)


def with_buses(farm: Plants) -> Path:
    for file in BUSES.iterdir():
        shutil.copy(file, farm.folder)
    return farm.folder


def is_op(appliance, *ports):
    values = appliance.values("one")
    return all(values[f"{port}.state"] == OP and values[f"{port}.wkc_ok"] for port in ports)


def describe(appliance, port="bus0"):
    return appliance.request("bus_describe", station="one", port=port)


def segments(appliance):
    """Process ids by port."""
    (info,) = appliance.runtime.glob("*/appliance.json")
    return {
        name.partition("/")[2]: process["pid"]
        for name, process in json.loads(info.read_text())["segments"].items()
    }


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    with_buses(module_farm)
    plant = module_farm.write(PLANT)
    return SharedAppliance(lambda: module_farm.run(plant))


@pytest.fixture
def running(shared: SharedAppliance) -> Appliance:
    appliance = shared.running()
    set_output(appliance, "bus0.buttons.valve", False)
    wait_until(lambda: is_op(appliance, "bus0", "bus1"))
    wait_until(lambda: appliance.values("one")["bus0.buttons.echo"] is False)
    return appliance


def states(interface):
    """States of the slaves, read by another master."""
    done = run_eapctl(Path(), "bus", "scan", "--interface", interface, "--json")
    assert done.returncode == 0, done.stderr
    return [slave["state"] for slave in json.loads(done.stdout)["slaves"]]


def set_output(appliance, name, value):
    appliance.request("write", station="one", values={name: value})


def test_two_buses_of_one_station(running):
    values = running.values("one")
    assert values["bus0.sensor.state"] == values["bus1.level.state"] == OP
    assert values["bus0.sensor.pressure"] in range(1011, 1016)
    assert values["bus0.buttons.echo"] is False
    set_output(running, "bus0.buttons.valve", True)
    wait_until(lambda: running.values("one")["bus0.buttons.echo"] is True)
    wait_until(lambda: running.values("one")["bus0.buttons.lamp"] is True)
    wait_until(lambda: running.values("one")["bus0.buttons.lamp"] is False)


def test_engine_that_is_killed(running):
    set_output(running, "bus0.buttons.valve", True)
    wait_until(lambda: running.values("one")["bus0.buttons.echo"] is True)
    before = running.station("one")["restarts"]
    for restarts in (before + 1, before + 2):
        os.kill(running.pid("engine"), signal.SIGKILL)
        wait_until(lambda count=restarts: running.station("one")["restarts"] == count)
        took_s = wait_until(lambda: is_op(running, "bus0", "bus1"))
        assert took_s < 2.0 * slowness()
        assert running.values("one")["bus0.buttons.echo"] is True
    assert running.stop()[0] == 0


def test_segment_that_is_killed(running):
    restarts = running.station("one")["restarts"]
    before, wrong = segments(running), describe(running, "bus1")["wkc_errors"]
    os.kill(before["bus0"], signal.SIGKILL)
    wait_until(lambda: running.values("one")["bus0.state"] == 0)
    values = running.values("one")
    assert (values["bus0.wkc_ok"], values["bus0.sensor.state"]) == (False, 0)
    assert values["bus1.state"] == OP
    wait_until(
        lambda: is_op(running, "bus0", "bus1")
    )  # busy machines lose an exchange now and then
    assert describe(running, "bus1")["wkc_errors"] == wrong
    assert segments(running)["bus0"] != before["bus0"]
    assert segments(running)["bus1"] == before["bus1"]
    assert running.station("one")["restarts"] == restarts


def test_services_that_are_killed_disturb_no_bus(running):
    before = describe(running)
    restarts = running.status()["processes"]["services"]["restarts"]
    os.kill(running.pid("services"), signal.SIGKILL)
    wait_until(lambda: running.status()["processes"]["services"]["restarts"] == restarts + 1)
    after = describe(running)
    assert after["cycles_good"] > before["cycles_good"]
    assert after["wkc_errors"] == before["wkc_errors"]
    values = running.values("one")
    assert (values["bus0.state"], values["bus1.state"]) == (OP, OP)
    wait_until(lambda: is_op(running, "bus0", "bus1"))


def test_nothing_is_left_in_time(running):
    pids = [*segments(running).values(), running.pid("engine"), running.pid("services")]
    took_s = wait_until(lambda: running.stop()[0] == 0)
    assert took_s < 2.0 * slowness()
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def test_supervisor_that_is_killed_takes_all_with_it(running):
    pids = [*segments(running).values(), running.pid("engine"), running.pid("services")]
    running.process.kill()
    running.process.communicate()
    wait_until(lambda: not [pid for pid in pids if Path(f"/proc/{pid}").exists()])


def test_bus_that_comes_late_and_goes(farm, folder):
    appliance = farm.run(farm.write(REMOTE))
    assert appliance.values("one")["bus0.state"] == 0
    for _ in range(2):
        with simulator(folder / "coe.yaml", f"udp://{SLAVES}"):
            wait_until(lambda: is_op(appliance, "bus0"))
            # The inputs follow the state by a cycle.
            wait_until(lambda: appliance.values("one")["bus0.sensor.pressure"] in range(1011, 1016))
        wait_until(lambda: appliance.values("one")["bus0.state"] == 0)
    assert appliance.stop()[0] == 0


def test_slaves_rest_when_the_plant_ends(farm, folder):
    plant = farm.write(REMOTE)
    with simulator(folder / "coe.yaml", f"udp://{SLAVES}"):
        appliance = farm.run(plant)
        wait_until(lambda: is_op(appliance, "bus0"))
        assert appliance.stop()[0] == 0
        assert states(f"udp://{SLAVES}") == ["INIT"] * 3


def test_wrong_bus_file_ends_the_start(farm, folder):
    plant = farm.write(PLANT)
    (folder / "coe.yaml").write_text("bus: x\nslaves: []\n")
    code, _, err = farm.start(plant).finish()
    assert code == 2
    assert "coe.yaml" in err


@pytest.mark.root
def test_interface_that_goes_and_comes_back(farm, folder):
    plant = farm.write(REMOTE.replace(f"udp://{SLAVES}", f"ethernet://{NEAR}"))
    with veth_pair(), simulator(folder / "coe.yaml"):
        appliance = farm.run(plant)
        wait_until(lambda: is_op(appliance, "bus0"))
        for _ in range(2):
            subprocess.run(["ip", "link", "set", NEAR, "down"], check=True)
            wait_until(lambda: appliance.values("one")["bus0.state"] == 0)
            assert "Network is down" in describe(appliance)["fault"]
            subprocess.run(["ip", "link", "set", NEAR, "up"], check=True)
            wait_until(lambda: is_op(appliance, "bus0"))
            assert describe(appliance)["fault"] == ""
        assert appliance.station("one")["restarts"] == 0
        assert appliance.stop()[0] == 0


SWAPPED = f"""
plant: swapped
stations:
  - name: line
    net_id: 5.1.2.1.1.1
    cycle_us: 5000
    ports:
      - name: bus0
        kind: bus
        interface: udp://{SLAVES}
        bus: swapped.yaml
        net_id: 5.1.2.1.3.1
"""


def test_bus_commands_of_swapped_slaves_name_both(farm):
    folder = with_buses(farm)
    bus = (folder / "coe.yaml").read_text()
    head, coupler, buttons, sensor = bus.split("  - name: ", 3)
    other = "  - name: ".join((head, coupler, sensor.rstrip() + "\n\n", buttons))
    (folder / "swapped.yaml").write_text(other)
    with simulator(BUSES / "coe.yaml", f"udp://{SLAVES}"):
        appliance = farm.run(farm.write(SWAPPED))

        def scan():
            done = run_eapctl(appliance.runtime, "bus", "scan", "line/bus0", "--json")
            assert done.returncode == 0, done.stderr
            return json.loads(done.stdout)

        wait_until(lambda: scan()["fault"])
        found = scan()
        assert [each["name"] for each in found["slaves"]] == ["coupler", "buttons", "sensor"]
        assert [each["name"] for each in found["expected"]] == ["coupler", "sensor", "buttons"]
        swap = "  sensor and buttons are swapped: exchange the cables or the names in the bus file"
        assert found["fault"].splitlines()[1:] == [swap]
        for command in ("diag", "state"):
            done = run_eapctl(appliance.runtime, "bus", command, "line/bus0")
            assert (done.returncode, done.stdout) == (1, "")
            assert done.stderr.splitlines()[1:] == [swap]
        assert "sensor and buttons are swapped" in run_eapctl(appliance.runtime, "status").stdout
