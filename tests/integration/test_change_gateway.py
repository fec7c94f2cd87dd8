"""Settings of a mailbox gateway become what a plant file says while its bus runs, and back."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, plants, run_eapctl, wait_until
from tests.support.gatewaywire import COE, frame, wire

pytestmark = pytest.mark.net

MILL, PRESS = "127.9.93.1", "127.9.93.2"
BUS = """\
bus: {name}
slaves:
  - {{name: drive, kind: drive, product: {product}, mailbox: {{size: 256, coe: true}}}}
"""
PLANT = f"""\
plant: changing
defaults: {{cycle_us: 10000}}
stations:
  - name: mill
    net_id: {MILL}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{MILL}", net_id: {MILL}.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://mill.yaml"
        net_id: {MILL}.3.1
        gateway: GATEWAY
  - name: press
    net_id: {PRESS}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{PRESS}", net_id: {PRESS}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://press.yaml", net_id: {PRESS}.3.1}}
"""
OWN, OTHER = 0x5621, 0x5622
PRODUCT = bytes.fromhex("0020 40 1810 02 00000000")
VIRTUAL = 0x9001
PROCESSES = ("engine", "services")


@pytest.fixture(scope="module")
def farm() -> Iterator[Plants]:
    with plants() as made:
        made.write(BUS.format(name="mill", product=OWN), "mill.yaml")
        made.write(BUS.format(name="press", product=OTHER), "press.yaml")
        yield made


@pytest.fixture(scope="module")
def file(farm: Plants) -> Path:
    return write(farm.folder / "plant.yaml", "{}")


@pytest.fixture(scope="module")
def appliance(farm: Plants, file: Path) -> Appliance:
    made = farm.run(file)
    wait_until(lambda: product() == OWN)
    return made


def write(file: Path, gateway: str) -> Path:
    file.write_text(PLANT.replace("GATEWAY", gateway))
    return file


def product(address: int = 1001, port: int = 34980) -> int:
    """Return the product of a slave by the gateway; 0 for an error."""
    with wire(MILL, port=port) as udp:
        kind, body = udp.talk(COE, address, PRODUCT)
    return int.from_bytes(body[6:10], "little") if kind == COE and body[2] == 0x43 else 0


def gateway(appliance: Appliance) -> dict[str, Any]:
    (row,) = appliance.request("gateway_status", station="mill")
    return dict(row)


def said(appliance: Appliance, *words: str) -> str:
    done = run_eapctl(appliance.runtime, *words)
    return " ".join((done.stdout + done.stderr).split())


def test_addresses_limits_and_state_follow_the_file(appliance: Appliance, file: Path) -> None:
    pids = [appliance.pid(name) for name in PROCESSES]
    assert product(VIRTUAL) == 0
    write(file, "{answer_ms: 1500, limits: {in_flight: 8}, addresses: {0x9001: press/bus0/1001}}")
    plan = said(appliance, "plan", str(file))
    assert "* gateway of bus0: answer_ms 900 -> 1500" in plan
    assert "* gateway of bus0: in_flight 32 -> 8" in plan
    assert "* gateway of bus0: address 0x9001: added" in plan
    assert "mill runs the new configuration: ok" in said(appliance, "apply", str(file))
    wait_until(lambda: product(VIRTUAL) == OTHER)
    settings = gateway(appliance)["settings"]
    assert (settings["answer_ms"], settings["in_flight"]) == (1500, 8)
    assert "no differences" in said(appliance, "plan", str(file))

    write(file, "{addresses: {0x9001: 1001}}")
    said(appliance, "apply", str(file))
    assert product(VIRTUAL) == OWN
    assert gateway(appliance)["settings"]["answer_ms"] == 900

    write(file, "{enabled: false}")
    assert "gateway of bus0: enabled True -> False" in said(appliance, "plan", str(file))
    said(appliance, "apply", str(file))
    assert gateway(appliance)["state"] == "stopped"
    with wire(MILL) as udp:
        udp.send(frame(COE, 1001, PRODUCT))
        wait_until(lambda: gateway(appliance)["dropped"] == 1)
        assert udp.rest() == []
    assert "ok" in said(appliance, "rollback", str(file))
    assert product(VIRTUAL) == OWN
    assert [appliance.pid(name) for name in PROCESSES] == pids

    os.kill(pids[1], signal.SIGKILL)
    appliance.wait_for_another("services", pids[1])
    wait_until(lambda: product(VIRTUAL) == OWN)
    values = appliance.values("mill")
    assert values["bus0.state"] == 8


def test_port_number_of_its_own_comes_and_goes(appliance: Appliance, file: Path) -> None:
    for port in (34999, 34998):
        write(file, f"{{port: {port}}}")
        appliance.command("apply", str(file))
        assert product(port=port) == OWN
        served = appliance.command("gateway", "status", "mill", "--json")
        assert f"{MILL}:{port}" in served
    write(file, "{}")
    appliance.command("apply", str(file))
    assert product() == OWN
    assert f"{MILL}:34998" not in appliance.command("gateway", "status", "mill", "--json")


def test_gateway_opens_again_for_a_full_dictionary(appliance: Appliance, file: Path) -> None:
    write(file, "{full: true}")
    assert "its gateway and ADS ports are opened again, its slaves go on" in said(
        appliance, "plan", str(file)
    )
    appliance.command("apply", str(file))
    assert product() == OWN
    write(file, "{}")
    appliance.command("apply", str(file))
    assert product() == OWN
