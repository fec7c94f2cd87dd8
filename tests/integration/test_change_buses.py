"""Buses and the settings of their slaves become what a plant file says while all else runs."""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import Appliance, Plants, run_eapctl, troubles, wait_until
from tests.support.gatewaywire import COE, wire
from tests.support.simulator import NEAR, simulator, veth_pair

pytestmark = pytest.mark.net

HERE, THERE = own_address(0), own_address(1)
DRIVE = """\
bus: drive
slaves:
  - {name: drive, kind: drive, product: 0x5621, mailbox: {size: 256, coe: true}}
"""
BUTTONS = """\
bus: buttons
slaves:
  - {name: coupler, kind: coupler}
  - name: buttons
    kind: digital
    inputs: [{name: echo, follows: lamp}]
    outputs: [{name: lamp}]
"""
BUSES = f"""\
      - name: bus0
        kind: bus
        interface: sim://drive.yaml
        net_id: {HERE}.3.1
      - name: bus1
        kind: bus
        interface: sim://buttons.yaml
        net_id: {HERE}.4.1
        # A busy machine stops the engine for longer than the 100 ms of the slave itself.
        slaves: {{buttons: {{watchdog: {{process_data_ms: 5000}}}}}}
"""
PLANT = f"""\
plant: buses
defaults: {{cycle_us: 5000}}
stations:
  - name: press
    net_id: {HERE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{HERE}", net_id: {HERE}.2.1}}
{BUSES}
    variables: {{beat: UINT}}
    sources: {{beat: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: mill/eap0}}]
    publish: [{{name: state, frame: out, id: 1, version: 1, variables: [beat]}}]
    links: [{{from: beat, bits: 1, to: bus1.buttons.lamp}}]
  - name: mill
    net_id: {THERE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{THERE}", net_id: {THERE}.2.1}}
    subscribe: [{{name: state, port: eap0, from: press/state, variables: {{beat: UINT}}}}]
"""
OF_DRIVE = f"net_id: {HERE}.3.1\n"
MODE = f"""{OF_DRIVE}\
        slaves:
          drive:
            startup: [{{sdo: "0x6060", value: 1}}]
"""
PROCESSES = ("engine", "services")
PRODUCT = bytes.fromhex("0020 40 1810 02 00000000")


class Works:
    """An appliance and its plant file, which the tests change."""

    def __init__(self, farm: Plants) -> None:
        self.farm = farm
        self.file = self.write(PLANT)
        farm.write(DRIVE, "drive.yaml")
        farm.write(BUTTONS, "buttons.yaml")
        self.appliance: Appliance = farm.run(self.file)
        self.wait_op("bus0", "bus1")

    def write(self, text: str) -> Path:
        return self.farm.write(text)

    def eapctl(self, *words: str) -> str:
        return self.appliance.command(*words)

    def plan(self) -> list[str]:
        return self.eapctl("plan", str(self.file)).splitlines()

    def apply(self) -> str:
        done = run_eapctl(self.appliance.runtime, "apply", str(self.file))
        assert done.returncode == 0, (done.stdout, done.stderr, self.appliance.log())
        return done.stdout

    def roll_back(self) -> str:
        return self.eapctl("rollback", str(self.file))

    def states(self) -> dict[str, Any]:
        values = self.appliance.values("press")
        return {name: value for name, value in values.items() if name.endswith(".state")}

    def wait_op(self, *ports: str) -> None:
        def are_up() -> bool:
            states = self.states()
            own = [states[name] for name in states if name.startswith(ports)]
            return set(own) == {8} and all(f"{port}.state" in states for port in ports)

        wait_until(are_up)

    def report(self, port: str) -> Any:
        return self.appliance.request("bus_describe", station="press", port=port)

    def mode(self) -> str:
        """Return the drive's mode, as soon as it is in OP: apply does not wait for buses."""
        self.eapctl("bus", "state", "press/bus0", "drive", "OP")
        return self.eapctl("bus", "sdo", "read", "press/bus0", "drive", "0x6060")

    def undisturbed(self) -> tuple[Any, ...]:
        """Return counters that stay while only another bus changes."""
        bus, pd = self.report("bus1"), self.appliance.rx("mill", "state")
        slaves = [(each["losses"], each["departures"]) for each in bus["slaves"]]
        return troubles(pd), bus["cycles_lost"], bus["wkc_errors"], slaves


@pytest.fixture(scope="module")
def works(module_farm: Plants) -> Works:
    return Works(module_farm)


@pytest.fixture(autouse=True)
def as_before(works: Works) -> Iterator[None]:
    """Have each test begin with the first plant file."""
    yield
    works.write(PLANT)
    works.farm.write(DRIVE, "drive.yaml")
    works.farm.write(BUTTONS, "buttons.yaml")
    works.apply()
    works.wait_op("bus0", "bus1")


def test_start_up_write_takes_effect_and_goes_back(works: Works) -> None:
    assert works.mode().startswith("0x6060:00 = SINT 8")
    before = works.undisturbed()
    received = works.appliance.rx("mill", "state")["received"]
    works.write(PLANT.replace(OF_DRIVE, MODE))
    assert works.plan()[:3] == [
        "press",
        "  * bus0 restarts: its slaves go to INIT, and to OP again",
        "  * bus0.drive: start-up write PS 0x6060:00 none -> 01",
    ]
    assert "press runs the new configuration: ok" in works.apply()
    works.wait_op("bus0")
    assert works.mode().startswith("0x6060:00 = SINT 1")
    assert works.plan() == ["no differences: all 2 stations are as the file says"]
    assert "press runs the new configuration: ok" in works.roll_back()
    works.wait_op("bus0")
    assert works.report("bus0")["slaves"][0]["losses"] == 0
    assert works.undisturbed() == before
    assert works.appliance.rx("mill", "state")["received"] > received


@pytest.mark.parametrize("process", PROCESSES)
def test_changed_settings_outlive_a_killed_process(works: Works, process: str) -> None:
    works.write(PLANT.replace(OF_DRIVE, MODE))
    works.apply()
    works.wait_op("bus0")
    pid = works.appliance.pid(process)
    os.kill(pid, signal.SIGKILL)
    works.appliance.wait_for_another(process, pid)
    works.wait_op("bus0", "bus1")
    assert works.plan() == ["no differences: all 2 stations are as the file says"]
    assert works.mode().startswith("0x6060:00 = SINT 1")


def test_bus_goes_to_another_target(works: Works) -> None:
    works.write(PLANT.replace("sim://drive.yaml", "sim://drive.yaml\n        target: PREOP"))
    assert "  * bus0: target OP -> PREOP" in works.plan()
    works.apply()
    wait_until(lambda: works.states()["bus0.state"] == 2)
    assert works.states()["bus1.state"] == 8


def test_simulated_slaves_are_exchanged_and_come_back(works: Works) -> None:
    before = works.undisturbed()
    with_file = DRIVE.replace("slaves:", "slaves:\n  - {name: coupler, kind: coupler}")
    works.farm.write(with_file, "drive.yaml")
    lines = works.plan()
    assert lines[1] == "  * bus0 restarts: its slaves go to INIT, and to OP again"
    assert "  * bus0.coupler: added, station address 1001" in lines
    assert "  * bus0.drive: station address 1001 -> 1002" in lines
    works.apply()
    works.wait_op("bus0")
    assert [each["name"] for each in works.report("bus0")["slaves"]] == ["coupler", "drive"]
    assert works.states()["bus0.coupler.state"] == 8
    for process in PROCESSES:
        pid = works.appliance.pid(process)
        os.kill(pid, signal.SIGKILL)
        works.appliance.wait_for_another(process, pid)
        works.wait_op("bus0", "bus1")
        assert [each["name"] for each in works.report("bus0")["slaves"]] == ["coupler", "drive"]
    works.roll_back()
    works.wait_op("bus0")
    assert [each["name"] for each in works.report("bus0")["slaves"]] == ["drive"]
    assert "bus0.coupler.state" not in works.states()
    if before[1:3] != works.undisturbed()[1:3]:  # the kill of the engine made another master
        assert works.report("bus1")["is_up"]


def test_optional_slave_is_added_by_the_bus_file(works: Works) -> None:
    before = works.undisturbed()
    optional = """\
  - name: spare
    kind: digital
    outputs: [{name: lamp}]
    master: {optional: true}
"""
    works.farm.write(DRIVE + optional, "drive.yaml")
    assert "  * bus0.spare: added, optional, station address 1002" in works.plan()
    works.apply()
    works.wait_op("bus0")
    wait_until(lambda: works.states()["bus0.spare.state"] == 8)
    works.eapctl("pd", "set", "press", "bus0.spare.lamp", "true")
    assert works.undisturbed() == before


def test_broken_bus_file_is_refused(works: Works) -> None:
    before = works.undisturbed()
    works.farm.write(DRIVE.replace("kind: drive", "kind: dryve"), "drive.yaml")
    done = run_eapctl(works.appliance.runtime, "apply", str(works.file))
    assert done.returncode
    assert "drive.yaml:3" in done.stderr
    assert works.states()["bus0.state"] == 8
    assert works.undisturbed() == before


MILL = f"net_id: {THERE}.2.1}}\n"


def with_bus_at_mill(interface: str, more: str = "") -> str:
    """Return the plant with a bus at the second station."""
    rows = (
        f'      - {{name: bus0, kind: bus, interface: "{interface}", net_id: {THERE}.3.1{more}}}\n'
    )
    return PLANT.replace(MILL, MILL + rows)


class Client(threading.Thread):
    """Reads an object of the drive by the gateway of the first station until told to stop."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[int] = []
        self._ending = threading.Event()
        self.start()

    def run(self) -> None:
        with suppress(ConnectionRefusedError):  # the appliance has ended, by a failed test
            while not self._ending.is_set():
                self.products.append(product(HERE))

    def end(self) -> set[int]:
        self._ending.set()
        self.join()
        return set(self.products)


def product(address: str, port: int = 34980) -> int:
    """Return the product of the first slave by a gateway; 0 without an answer, or for an error."""
    with wire(address, port=port) as udp:
        try:
            kind, body = udp.talk(COE, 1001, PRODUCT)
        except TimeoutError:
            return 0
    return int.from_bytes(body[6:10], "little") if kind == COE and body[2] == 0x43 else 0


def mill(works: Works) -> dict[str, Any]:
    values = works.appliance.values("mill")
    return {name: value for name, value in values.items() if name.startswith("bus0.")}


def test_bus_comes_and_goes_under_load(works: Works) -> None:
    before = works.undisturbed()
    client = Client()
    assert product(THERE) == 0
    works.write(with_bus_at_mill("sim://drive.yaml"))
    lines = works.plan()
    assert lines[0] == "mill"
    assert lines[1].startswith("  * bus0: added at sim://")
    assert lines[1].endswith("drive.yaml, 1 slaves go to OP")
    works.apply()
    wait_until(lambda: mill(works)["bus0.state"] == 8)
    assert product(THERE) == 0x5621
    assert "mill/bus0/1001" in works.eapctl("scan")
    assert works.eapctl("bus", "sdo", "read", "mill/bus0", "drive", "0x1018:2")
    assert "mill/bus0" in works.appliance.status()["processes"]["segments"]
    works.write(PLANT)
    assert works.plan()[1] == "  * bus0: removed, its slaves go to INIT"
    works.apply()
    assert mill(works) == {}
    assert product(THERE) == 0
    assert "mill/bus0" not in works.eapctl("scan")
    wait_until(lambda: "mill/bus0" not in works.appliance.status()["processes"]["segments"])
    assert client.end() == {0x5621}
    assert works.undisturbed() == before


@pytest.mark.parametrize("process", PROCESSES)
def test_added_bus_outlives_a_killed_process(works: Works, process: str) -> None:
    works.write(with_bus_at_mill("sim://buttons.yaml"))
    works.apply()
    pid = works.appliance.pid(process)
    os.kill(pid, signal.SIGKILL)
    works.appliance.wait_for_another(process, pid)
    wait_until(lambda: mill(works).get("bus0.state") == 8)
    works.wait_op("bus0", "bus1")
    assert works.plan() == ["no differences: all 2 stations are as the file says"]
    works.roll_back()
    assert mill(works) == {}


def test_remote_slaves_are_in_init_when_their_bus_is_gone(works: Works) -> None:
    interface = f"udp://{own_address(2)}"
    with simulator(works.farm.folder / "buttons.yaml", interface):
        works.write(with_bus_at_mill(interface, ", bus: buttons.yaml"))
        works.apply()
        wait_until(lambda: mill(works)["bus0.state"] == 8)
        works.write(PLANT)
        works.apply()
        assert mill(works) == {}

        def states() -> set[str]:
            found = json.loads(works.eapctl("bus", "scan", "--interface", interface, "--json"))
            return {slave["state"] for slave in found["slaves"]}

        wait_until(lambda: states() == {"INIT"})


def test_third_bus_has_a_gateway_port_of_its_own(works: Works) -> None:
    before = works.undisturbed()
    last = BUSES[BUSES.index("      - name: bus1") :]
    third = last.replace("bus1", "bus2").replace(".4.1", ".5.1").replace("buttons", "drive")
    works.write(PLANT.replace(last, last + third))
    works.apply()
    works.wait_op("bus2")
    assert product(HERE, 34982) == 0x5621
    assert f"udp://{HERE}:34982" in works.eapctl("gateway", "status")
    works.write(PLANT)
    works.apply()
    with suppress(ConnectionRefusedError):
        assert product(HERE, 34982) == 0
    assert works.undisturbed() == before


@pytest.mark.root
def test_bus_at_an_ethernet_interface_comes_and_goes(farm: Plants) -> None:
    farm.write(DRIVE, "drive.yaml")
    bus_file = farm.write(BUTTONS, "buttons.yaml")
    with veth_pair(), simulator(bus_file):
        file = farm.write(PLANT)
        appliance = farm.run(file)
        rx = appliance.rx("mill", "state")
        farm.write(with_bus_at_mill(f"ethernet://{NEAR}", ", bus: buttons.yaml"))
        appliance.command("apply", str(file))
        wait_until(lambda: appliance.values("mill")["bus0.state"] == 8)
        appliance.command("rollback", str(file))
        assert "bus0.state" not in appliance.values("mill")
        found = json.loads(
            appliance.command("bus", "scan", "--interface", f"ethernet://{NEAR}", "--json")
        )
        assert {slave["state"] for slave in found["slaves"]} == {"INIT"}
        assert troubles(appliance.rx("mill", "state")) == troubles(rx)
        assert appliance.stop()[0] == 0


def test_bus_whose_lines_cannot_be_opened_changes_nothing(works: Works) -> None:
    before = works.undisturbed()
    works.write(with_bus_at_mill("ethernet://nothere"))
    done = run_eapctl(works.appliance.runtime, "apply", str(works.file))
    assert done.returncode
    assert "nothere" in done.stdout + done.stderr
    assert mill(works) == {}
    assert works.undisturbed() == before
    works.write(PLANT)
    assert works.plan() == ["no differences: all 2 stations are as the file says"]


def test_invalid_settings_change_nothing(works: Works) -> None:
    before = works.report("bus0")["frames_sent"], works.undisturbed()
    works.write(PLANT.replace(OF_DRIVE, MODE.replace("value: 1", "value: 800")))
    done = run_eapctl(works.appliance.runtime, "apply", str(works.file))
    assert done.returncode
    assert "800" in done.stderr
    assert works.report("bus0")["slaves"][0]["state"] == 8
    assert works.report("bus0")["frames_sent"] > before[0]
    assert works.undisturbed() == before[1]
