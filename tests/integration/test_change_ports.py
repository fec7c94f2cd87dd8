"""EAP ports come, change and go by ``eapctl apply`` while other ports lose no frame."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import EAPCTL, Appliance, Plants, run_eapctl, troubles, wait_until
from tests.support.namespaces import Namespace, cable

pytestmark = pytest.mark.net

OVEN, PANEL = "127.9.94.1", "127.9.94.2"
PLANT = f"""\
plant: ports
defaults: {{cycle_us: 10000}}
stations:
  - name: oven
    net_id: {OVEN}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{OVEN}", net_id: {OVEN}.2.1}}
OVEN_PORTS
    variables: {{ticks: UDINT, power: UDINT}}
    sources: {{ticks: {{kind: counter}}, power: {{kind: counter}}}}
    frames:
      - {{name: to-panel, port: eap0, to: panel/eap0}}
OVEN_FRAMES
    publish:
      - {{name: state, frame: to-panel, id: 1, variables: [ticks]}}
OVEN_PUBLISH
  - name: panel
    net_id: {PANEL}.1.1
    phase_us: 5000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{PANEL}", net_id: {PANEL}.2.1}}
PANEL_PORTS
    subscribe:
      - {{name: state, port: eap0, from: oven/state, timeout_ms: 1000}}
PANEL_SUBSCRIBE
"""
PLACES = ("OVEN_PORTS", "OVEN_FRAMES", "OVEN_PUBLISH", "PANEL_PORTS", "PANEL_SUBSCRIBE")


def plant_text(*interfaces: str, more: str = "") -> str:
    """Return the plant, with a second port of both stations at two *interfaces* if there are."""
    text = PLANT
    lines = [""] * len(PLACES)
    if interfaces:
        is_ethernet = interfaces[0].startswith("ethernet")
        destination = "multicast" if is_ethernet else "panel/eap1"
        ports = [
            f'      - {{name: eap1, kind: eap, interface: "{interface}", net_id: {net_id}{more}}}'
            for interface, net_id in zip(interfaces, (f"{OVEN}.2.2", f"{PANEL}.2.2"), strict=True)
        ]
        lines = [
            ports[0],
            f"      - {{name: more, port: eap1, to: {destination}}}",
            "      - {name: power, frame: more, id: 2, variables: [power]}",
            ports[1],
            "      - {name: power, port: eap1, from: oven/power, timeout_ms: 1000}",
        ]
    for place, line in zip(PLACES, lines, strict=True):
        text = text.replace(f"{place}\n", f"{line}\n" if line else "")
    return text


FIRST = plant_text()
LOOP = plant_text("loop://second", "loop://second")
UDP = plant_text("udp://127.9.94.11", "udp://127.9.94.12")
MOVED = plant_text("udp://127.9.94.21", "udp://127.9.94.22")
TAKING_TCP = plant_text(
    "udp://127.9.94.11", "udp://127.9.94.12", more=', tcp: true, join: ["239.1.2.3"]'
)
WAKING = plant_text("udp://127.9.94.11", "udp://127.9.94.12", more=", wake: arrival, ams: false")


class Plant:
    """The running plant and its file."""

    def __init__(self, farm: Plants) -> None:
        self._farm = farm
        self.file = farm.write(FIRST, "ports.yaml")
        self.appliance = self.start()

    def start(self) -> Appliance:
        appliance = self._farm.start(self.file, runtime=self._farm.folder / "run")
        appliance.wait_ready()
        return appliance

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return run_eapctl(self.appliance.runtime, *words, str(self.file))

    def apply(self, text: str) -> str:
        self.file.write_text(text)
        done = self.run("apply")
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def ports(self) -> dict[str, list[str]]:
        """Return the interfaces of each station as it runs."""
        return {
            name: [
                port["interface"]
                for port in self.appliance.request("export", station=name)["spec"]["ports"]
            ]
            for name in ("oven", "panel")
        }

    def rx(self) -> dict[str, dict[str, Any]]:
        return {rx["name"]: rx for rx in self.appliance.station("panel")["pd"]["rx"]}

    def receive(self, *names: str) -> dict[str, dict[str, Any]]:
        """Return the subscriptions once each of *names* has received twenty more frames."""
        before = self.rx()
        assert before.keys() == set(names)
        wait_until(
            lambda: all(
                rx["received"] >= before[name]["received"] + 20 for name, rx in self.rx().items()
            )
        )
        return self.rx()

    def addresses(self) -> set[str]:
        """Return the addresses at which a process of this host has a socket of the plant."""
        found = set()
        for table in ("udp", "tcp"):
            rows = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()]
            # Listeners and unconnected sockets: other connections end later, in TIME_WAIT.
            numbers = [row[1].partition(":")[0] for row in rows if row[3] in {"07", "0A"}]
            found |= {socket.inet_ntoa(bytes.fromhex(each)[::-1]) for each in numbers}
        return {each for each in found if each.startswith("127.9.94.")}


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Plant:
    return Plant(module_farm)


@pytest.fixture
def plant(shared: Plant) -> Plant:
    if shared.appliance.process.poll() is not None:
        shared.appliance = shared.start()
    shared.apply(FIRST)
    shared.receive("state")
    return shared


def assert_nothing_lost(before: dict[str, Any], after: dict[str, Any]) -> None:
    assert troubles(after) == troubles(before)
    assert after["discarded"] == before["discarded"]
    assert after["state"] == "running"


def test_ports_come_change_and_go_while_another_loses_nothing(plant: Plant) -> None:
    before = plant.rx()["state"]
    discarded = plant.appliance.station("panel")["discarded"]
    cycles = plant.appliance.station("oven")["cycle"]
    plant.file.write_text(UDP)
    plan = plant.run("plan").stdout
    assert "* port eap1: added at udp://127.9.94.11" in plan
    assert "* port eap1: added at udp://127.9.94.12" in plan
    assert plant.addresses() == {OVEN, PANEL}
    for text, there in (
        (UDP, {"127.9.94.11", "127.9.94.12"}),
        (TAKING_TCP, {"127.9.94.11", "127.9.94.12"}),
        (UDP, {"127.9.94.11", "127.9.94.12"}),
        (MOVED, {"127.9.94.21", "127.9.94.22"}),
        (LOOP, set[str]()),
        (WAKING, {"127.9.94.11", "127.9.94.12"}),
        (FIRST, set[str]()),
        (UDP, {"127.9.94.11", "127.9.94.12"}),
    ):
        assert "2 stations changed" in plant.apply(text)
        names = ("state",) if text is FIRST else ("state", "power")
        after = plant.receive(*names)
        assert_nothing_lost(before, after["state"])
        assert all(rx["lost"] == 0 for rx in after.values())
        wait_until(lambda there=there: plant.addresses() == {OVEN, PANEL, *there})
        assert plant.run("plan").stdout.startswith("no differences")
    assert "2 stations changed" in plant.run("rollback").stdout
    assert_nothing_lost(before, plant.receive("state")["state"])
    assert plant.addresses() == {OVEN, PANEL}
    assert "2 stations changed" in plant.run("rollback").stdout
    assert_nothing_lost(before, plant.receive("state", "power")["state"])
    assert plant.appliance.station("oven")["cycle"] > cycles
    processes = plant.appliance.status()["processes"]
    assert [processes[name]["restarts"] for name in ("engine", "services")] == [0, 0]
    now = plant.appliance.station("panel")["discarded"]
    assert {key: now[key] for key in now if now[key] != discarded.get(key, 0)}.keys() <= {"stale"}


def test_new_ports_have_dictionaries_routes_and_listeners(plant: Plant) -> None:
    plant.apply(UDP)
    appliance = plant.appliance
    assert "0x1A00" in appliance.command("od", "list", "oven/eap1")
    assert "eap1" in appliance.command("od", "list", "oven/router")
    ports = {port["name"]: port for port in appliance.station("oven")["ports"]}
    assert ports["eap1"]["link"] == "up"
    with socket.create_connection(("127.9.94.11", 48898), 5) as client:
        client.settimeout(20)
        plant.apply(FIRST)
        assert client.recv(1) == b""  # the listener is gone, and its connections with it
    wait_until(lambda: plant.addresses() == {OVEN, PANEL})
    done = run_eapctl(appliance.runtime, "od", "list", "oven/eap1")
    assert done.returncode != 0
    assert "its EAP ports are eap0" in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("interfaces", "reason"),
    [
        (("ethernet://nothere", "ethernet://nothere"), "nothere"),
        (("udp://192.0.2.77", "udp://192.0.2.78"), "192.0.2.7"),
        (("udp://127.9.94.31", "udp://127.9.94.32"), "127.9.94.31:34980 is in use by"),
        (("udp://0.0.0.0:5000", "udp://0.0.0.0:5001"), "comes and goes at a start only"),
    ],
)
def test_port_that_cannot_be_opened_is_refused(
    plant: Plant, interfaces: tuple[str, str], reason: str
) -> None:
    before, ports = plant.rx()["state"], plant.ports()
    plant.file.write_text(plant_text(*interfaces))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as squatter:
        squatter.bind(("127.9.94.31", 34980))
        done = plant.run("apply", "--keep-going", "--station", "oven")
    assert done.returncode != 0
    assert reason in done.stdout + done.stderr
    assert plant.ports() == ports
    assert_nothing_lost(before, plant.receive("state")["state"])
    assert plant.addresses() == {OVEN, PANEL}
    plant.apply(UDP)
    plant.receive("state", "power")


def test_applied_ports_survive_a_restart_and_give_way_to_the_plant_file(plant: Plant) -> None:
    plant.apply(UDP)
    plant.run("rollback")
    plant.run("rollback")
    plant.file.write_text(UDP)
    assert plant.appliance.stop()[0] == 0
    plant.appliance = plant.start()
    assert plant.ports()["oven"] == [f"udp://{OVEN}", "udp://127.9.94.11"]
    plant.receive("state", "power")
    plant.run("rollback")
    for victim in ("engine", "services"):
        pid = plant.appliance.pid(victim)
        os.kill(pid, signal.SIGKILL)
        plant.appliance.wait_for_another(victim, pid)
        plant.receive("state")
    plant.run("rollback")
    plant.receive("state", "power")


@pytest.mark.parametrize("victim", ["engine", "services", "supervisor"])
@pytest.mark.parametrize("delay_ms", [0, 5, 10, 20, 30] if os.environ.get("EAP_LONG") else [10])
@pytest.mark.parametrize("grows", [True, False], ids=["added", "removed"])
def test_kill_in_the_middle_leaves_whole_configurations(
    plant: Plant, victim: str, delay_ms: int, *, grows: bool
) -> None:
    old, new = (FIRST, UDP) if grows else (UDP, FIRST)
    plant.apply(old)
    known = [plant.ports()]
    pids = {name: plant.appliance.pid(name) for name in ("engine", "services", "supervisor")}
    plant.file.write_text(new)
    environment = os.environ | {"EAP_RUNTIME_DIR": str(plant.appliance.runtime)}
    with subprocess.Popen(
        [*EAPCTL, "apply", str(plant.file)], env=environment, stdout=subprocess.PIPE, text=True
    ) as apply:
        assert apply.stdout is not None
        apply.stdout.readline()  # one step is done, the next begins
        time.sleep(delay_ms / 1000)  # another moment of the change
        os.kill(pids[victim], signal.SIGKILL)
        apply.communicate(timeout=70)
    if victim == "supervisor":
        plant.appliance.process.wait()
        plant.appliance = plant.start()
    else:
        plant.appliance.wait_for_another(victim, pids[victim])
    wait_until(lambda: plant.run("status").returncode == 0 or True)
    done = plant.apply(new)
    assert "changed" in done or "no differences" in done
    names = ("state", "power") if grows else ("state",)
    plant.receive(*names)
    known.append(plant.ports())
    assert len(known[1]["oven"]) == len(known[1]["panel"]) == 1 + grows
    there = {"127.9.94.11", "127.9.94.12"} if grows else set()
    wait_until(lambda: plant.addresses() == {OVEN, PANEL, *there})


VLANS = """\
plant: vlans
defaults: {cycle_us: 5000}
stations:
LEFT
RIGHT
"""
STATION = """\
  - name: NAME
    net_id: 10.88.94.NUMBER.1.1
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://line0", net_id: 10.88.94.NUMBER.2.1}
PORTS
    variables: {ticks: UDINT, more: UDINT}
    sources: {ticks: {kind: counter}, more: {kind: counter}}
    frames:
      - {name: to-all, port: eap0, to: multicast}
FRAMES
    publish:
      - {name: state, frame: to-all, id: 1, variables: [ticks]}
PUBLISH
    subscribe:
      - {name: peer, port: eap0, from: OTHER/state, timeout_ms: 1000}
SUBSCRIBE
"""


def vlan_text(vlan: int | None) -> str:
    """Return the plant, with second ports in *vlan* on the same interfaces."""
    stations = STATION
    lines = dict.fromkeys(("PORTS", "FRAMES", "PUBLISH", "SUBSCRIBE"), "")
    if vlan is not None:
        lines = {
            "PORTS": "      - {name: eap1, kind: eap, interface: 'ethernet://line0',"
            f" net_id: 10.88.94.NUMBER.2.2, vlan: {{id: {vlan}}}}}\n",
            "FRAMES": "      - {name: tagged, port: eap1, to: multicast}\n",
            "PUBLISH": "      - {name: more, frame: tagged, id: 2, variables: [more]}\n",
            "SUBSCRIBE": "      - {name: more-peer, port: eap1, from: OTHER/more,"
            " timeout_ms: 1000}\n",
        }
    for place, line in lines.items():
        stations = stations.replace(f"{place}\n", line)
    text = VLANS
    for place, name, number, other in (
        ("LEFT", "left", "1", "right"),
        ("RIGHT", "right", "2", "left"),
    ):
        station = stations.replace("NAME", name).replace("NUMBER", number).replace("OTHER", other)
        text = text.replace(f"{place}\n", station)
    return text


class End:
    """An appliance at one end of a cable."""

    def __init__(self, farm: Plants, name: str, namespace: Namespace) -> None:
        self.name = name
        self.file = farm.write(vlan_text(None), f"{name}.yaml")
        self.appliance = farm.start(
            self.file, "--station", name,
            prefix=namespace.prefix, runtime=farm.folder / f"run-{name}",
        )  # fmt: skip

    def apply(self, vlan: int | None) -> None:
        self.file.write_text(vlan_text(vlan))
        done = run_eapctl(self.appliance.runtime, "apply", str(self.file), "--station", self.name)
        assert done.returncode == 0, done.stdout + done.stderr

    def received(self, pd: str) -> int:
        return int(self.appliance.rx(self.name, pd)["received"])


@pytest.mark.root
def test_vlans_of_one_interface_come_change_and_go(farm: Plants) -> None:
    with cable() as both:
        ends = [End(farm, name, end) for name, end in zip(("left", "right"), both, strict=True)]
        for end in ends:
            end.appliance.wait_ready()
        for end in ends:
            wait_until(lambda end=end: end.received("peer") > 20)
        before = [end.appliance.rx(end.name, "peer") for end in ends]
        for vlan in (5, 7, None, 5):
            for end in ends:
                end.apply(vlan)
            for end, was in zip(ends, before, strict=True):
                for pd in ("peer", *(["more-peer"] if vlan else [])):
                    now = end.received(pd)
                    wait_until(lambda end=end, pd=pd, now=now: end.received(pd) > now + 20)
                rx = end.appliance.rx(end.name, "peer")
                assert_nothing_lost(was, rx)
                if vlan:
                    assert end.appliance.rx(end.name, "more-peer")["lost"] == 0
        for end in ends:
            end.appliance.stop()
