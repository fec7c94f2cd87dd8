"""Cable redundancy of a running plant: a ring that is cut and mended, on both kinds of lines."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import Appliance, Plants, SharedAppliance, wait_until
from tests.support.simulator import FAR_2, NEAR, NEAR_2, simulator, veth_pair

pytestmark = pytest.mark.net

OP = 8
NAMES = ("coupler", "buttons", "valves", "sensor")
BUS = """
bus: ring
ring: true
slaves:
  - {name: coupler, kind: coupler}
  - name: buttons
    kind: digital
    product: 0x03F03052
    inputs: [{name: echo, follows: lamp}]
    outputs: [{name: lamp}]
  - name: valves
    kind: digital
    product: 0x07D83052
    inputs: [{name: echo, follows: valve}]
    outputs: [{name: valve}]
  - name: sensor
    kind: analogue
    product: 0x0BBC3052
    inputs: [{name: level, type: INT, follows: limit}]
    outputs: [{name: limit, type: INT}]
"""
PLANT = """
plant: ring
stations:
  - name: one
    net_id: 5.1.1.1.1.1
    cycle_us: 2000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{address}", net_id: 5.1.1.1.2.1}}
      - {{name: bus0, kind: bus, net_id: 5.1.1.1.3.1, clocks: true, {lines}}}
"""
SIMULATED = 'interface: "sim://ring.yaml", redundant: "sim://ring.yaml"'


def with_bus(farm: Plants) -> Path:
    (farm.folder / "ring.yaml").write_text(BUS)
    return farm.folder


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    with_bus(module_farm)
    plant = module_farm.write(PLANT.format(address=own_address(0), lines=SIMULATED))
    return SharedAppliance(lambda: module_farm.run(plant))


@pytest.fixture
def running(shared: SharedAppliance) -> Appliance:
    appliance = shared.running()
    wait_until(lambda: is_op(appliance))
    return appliance


def is_op(appliance: Appliance) -> bool:
    values = appliance.values("one")
    states = [values[f"bus0.{name}.state"] for name in NAMES]
    return states == [OP] * 4 and values["bus0.wkc_ok"]


def bus_of(appliance: Appliance) -> dict:
    return appliance.station("one")["ports"][1]["bus"]


def check_data(appliance: Appliance) -> None:
    """Check that outputs reach slaves on all sides of a cut, and that their inputs come."""
    for number in (3, -4):
        on = number > 0
        values = {"bus0.buttons.lamp": on, "bus0.valves.valve": on, "bus0.sensor.limit": number}
        appliance.request("write", station="one", values=values)
        wanted = {"bus0.buttons.echo": on, "bus0.valves.echo": on, "bus0.sensor.level": number}
        wait_until(lambda wanted=wanted: wanted.items() <= appliance.values("one").items())
    values = appliance.values("one")
    assert [values[f"bus0.{name}.state"] for name in NAMES] == [OP] * 4


def counts(appliance: Appliance) -> tuple[int, ...]:
    bus = bus_of(appliance)
    return bus["wkc_errors"], bus["lost"], bus["cycles"]


def diag(appliance: Appliance) -> str:
    return " ".join(appliance.command("bus", "diag", "one/bus0").split())


CUTS = [
    pytest.param("slave=coupler", None, "coupler", id="first line"),
    pytest.param("slave=valves", "buttons", "valves", id="middle"),
    pytest.param("second=true", "sensor", None, id="second line"),
]


@pytest.mark.parametrize(("where", "before", "behind"), CUTS)
def test_cut_ring_goes_on_and_names_the_place(running: Appliance, where, before, behind):
    wait_until(lambda: bus_of(running)["ring"]["is_whole"])
    first = counts(running)
    running.command("sim", "fault", "one/bus0", "cut", where)
    check_data(running)
    wait_until(lambda: bus_of(running)["ring"]["between"])
    ring = bus_of(running)["ring"]
    assert ring["is_whole"] is False
    assert [each and each["name"] for each in ring["between"]] == [before, behind]
    ends = [each and f"{each} ({1001 + NAMES.index(each)})" for each in (before, behind)]
    ends = [ends[0] or "the first line of the master", ends[1] or "the second line of the master"]
    text = f"the ring is cut between {ends[0]} and {ends[1]}"
    wait_until(lambda: text in (shown := diag(running)) and "errors start at" not in shown)
    assert text in json.dumps(running.request("status"))
    scan = json.loads(running.command("bus", "scan", "one/bus0", "--json"))
    assert [each["name"] for each in scan["slaves"]] == list(NAMES)
    vendor = running.command("bus", "sdo", "read", "one/bus0", "sensor", "0x1018:1", "--json")
    assert json.loads(vendor)["value"] == 0x0E5A
    running.command("sim", "fault", "one/bus0", "cut", where, "--end")
    check_data(running)
    wait_until(lambda: bus_of(running)["ring"]["is_whole"])
    wait_until(lambda: f"the ring was cut between {ends[0]} and {ends[1]}" in diag(running))
    last = counts(running)
    # Frames that were under way when the cable was cut, or mended.
    assert last[0] - first[0] <= 4
    assert last[1] - first[1] <= 4
    assert last[2] > first[2]
    running.command("bus", "diag", "one/bus0", "--reset")
    wait_until(lambda: "the ring was cut" not in diag(running))


def test_emergencies_of_a_slave_are_shown_until_they_are_taken_back(running: Appliance):
    fault = ("sim", "fault", "one/bus0", "emergency", "slave=sensor", "code=0x8611")
    running.command(*fault)
    text = "sensor (1004) reports emergency 0x8611 by CoE: monitoring, error register 0x01"
    wait_until(lambda: text in diag(running))
    shown = diag(running)
    assert "Emergency Meaning" in shown
    assert "0x8611 monitoring" in shown
    assert text in running.command("status")
    found = json.loads(running.command("bus", "diag", "one/bus0", "sensor", "--json"))["slaves"]
    assert found[0]["latest_emergencies"][0]["code"] == 0x8611
    running.command(*fault, "--end")
    wait_until(lambda: text not in diag(running))
    assert bus_of(running)["slaves"][3]["last_emergency"]["code"] == 0
    running.command("bus", "diag", "one/bus0", "--reset")
    assert "0x8611" not in diag(running)


@pytest.mark.root
def test_ring_over_two_interfaces_survives_each_of_its_cables(farm: Plants):
    folder = with_bus(farm)
    lines = f'interface: "ethernet://{NEAR}", redundant: "ethernet://{NEAR_2}", bus: ring.yaml'
    with (
        veth_pair(),
        simulator(
            folder / "ring.yaml", "ethernet://far", "--second", f"ethernet://{FAR_2}"
        ) as slaves,
    ):
        appliance = farm.run(farm.write(PLANT.format(address="127.0.0.1", lines=lines)))
        wait_until(lambda: is_op(appliance))
        check_data(appliance)
        assert bus_of(appliance)["ring"]["is_whole"]
        slaves.fault(kind="cut", slave="valves")
        check_data(appliance)
        wait_until(lambda: bus_of(appliance)["ring"]["between"])
        slaves.fault(kind="cut", slave="valves", end=True)
        wait_until(lambda: bus_of(appliance)["ring"]["is_whole"])
        # The cable of the master itself: the slave at its end loses its link as well.
        for interface, cut in ((NEAR, {"slave": "coupler"}), (NEAR_2, {"second": True})):
            subprocess.run(["ip", "link", "set", interface, "down"], check=True)
            slaves.fault(kind="cut", **cut)
            wait_until(lambda: is_op(appliance))
            check_data(appliance)
            assert bus_of(appliance)["ring"]["is_whole"] is False
            subprocess.run(["ip", "link", "set", interface, "up"], check=True)
            slaves.fault(kind="cut", end=True, **cut)
            wait_until(lambda: bus_of(appliance)["ring"]["is_whole"])
            check_data(appliance)
        assert appliance.stop()[0] == 0


def test_ring_by_udp(farm: Plants):
    folder = with_bus(farm)
    first, second = (f"udp://{own_address(number)}" for number in (1, 2))
    lines = f'interface: "{first}", redundant: "{second}", bus: ring.yaml'
    with simulator(folder / "ring.yaml", first, "--second", second) as slaves:
        appliance = farm.run(farm.write(PLANT.format(address=own_address(3), lines=lines)))
        wait_until(lambda: is_op(appliance))
        assert bus_of(appliance)["ring"]["is_whole"]
        slaves.fault(kind="cut", slave="valves")
        check_data(appliance)
        assert bus_of(appliance)["ring"]["is_whole"] is False
        assert appliance.stop()[0] == 0


COUNT = 200
LONG_BUS = "bus: long\nring: true\nslaves:\n" + "".join(
    f"  - {{name: s{number}, kind: digital, product: 7, inputs: [{{name: echo, follows: lamp}}],"
    " outputs: [{name: lamp}]}\n"
    for number in range(COUNT)
)


def test_200_slaves_in_a_ring_keep_states_and_data_over_a_cut(farm: Plants):
    (farm.folder / "ring.yaml").write_text(LONG_BUS)
    plant = PLANT.format(address=own_address(3), lines=SIMULATED)
    # A simulated frame passes 200 slaves in milliseconds.
    appliance = farm.run(farm.write(plant.replace("cycle_us: 2000", "cycle_us: 20000")))

    def show(pattern: int) -> None:
        """Give each slave an output of its own, and wait until all inputs show them."""
        lamps = {f"bus0.s{n}.lamp": bool(pattern >> n % 7 & 1) for n in range(COUNT)}
        appliance.request("write", station="one", values=lamps)
        echoes = {name.replace("lamp", "echo"): value for name, value in lamps.items()}
        wait_until(lambda: echoes.items() <= appliance.values("one").items())

    def slaves() -> list[dict]:
        return bus_of(appliance).get("slaves", [])

    wait_until(lambda: len(slaves()) == COUNT and {each["state"] for each in slaves()} == {"OP"})
    show(0b1010011)
    appliance.command("sim", "fault", "one/bus0", "cut", "slave=s100")
    show(0b0101100)
    wait_until(lambda: bus_of(appliance)["ring"]["between"])
    assert [each["name"] for each in bus_of(appliance)["ring"]["between"]] == ["s99", "s100"]
    appliance.command("sim", "fault", "one/bus0", "cut", "slave=s100", "--end")
    show(0b1110001)
    wait_until(lambda: bus_of(appliance)["ring"]["is_whole"])
    report = appliance.request("bus_describe", station="one", port="bus0")
    assert {each["state"] for each in report["slaves"]} == {OP}
    assert {(each["losses"], each["departures"]) for each in report["slaves"]} == {(0, 0)}
    assert report["wkc_errors"] <= 4
    assert appliance.stop()[0] == 0
