"""Slaves that the plant file configures: a drive in CSP, an optional tool, what a slave refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import Plants, SharedAppliance, run_eapctl, wait_until

pytestmark = pytest.mark.net

PAGE = (Path(__file__).parents[2] / "docs" / "plant-file.md").read_text()
EXAMPLE, AXIS = re.findall(r"```yaml\n(# (?:axis|buses/axis).*?)```", PAGE, re.DOTALL)
STATION = own_address(0)
TOOLS = """
bus: tools
slaves:
  - {name: coupler, kind: coupler, product: 1}
  - name: tool
    kind: digital
    product: 2
    after: coupler
    port: 2
    inputs: [{name: echo, follows: out}]
    outputs: [{name: out}]
    objects: [{index: 0x8000, name: Filter, type: UINT}]
    master:
      optional: true
      startup: [{sdo: "0x8000", value: 7}]
  - name: end
    kind: digital
    product: 3
    after: coupler
    inputs: [{name: echo, follows: out}]
    outputs: [{name: out}]
  - name: strict
    kind: digital
    product: 4
    inputs: [{name: in}]
    objects: [{index: 0x8000, name: Gain, type: UINT, maximum: 10}]
faults:
  - {kind: cut, slave: tool}
"""
BUSES = f"""
  - name: cell
    net_id: 5.2.2.2.1.1
    cycle_us: 5000
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{own_address(1)}", net_id: 5.2.2.2.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://tools.yaml"
        net_id: 5.2.2.2.3.1
        slaves:
          strict:
            startup: [{{sdo: "0x8000", value: 99}}]
"""


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    folder = module_farm.folder
    (folder / "buses").mkdir()
    (folder / "buses" / "axis.yaml").write_text(AXIS)
    (folder / "tools.yaml").write_text(TOOLS)
    plant = module_farm.write(
        EXAMPLE.replace("10.0.0.1:", f"{STATION}:").replace("udp://10.0.0.1", f"udp://{STATION}")
        + BUSES
    )
    return SharedAppliance(lambda: module_farm.run(plant))


@pytest.fixture
def running(shared):
    return shared.running()


def registers(appliance, address, size):
    (reply,) = appliance.request(
        "bus_transfer", station="axis", port="bus0",
        datagrams=[(4, 1001, address, bytes(size).hex(), 0)],
    )["replies"]  # fmt: skip
    return int.from_bytes(bytes.fromhex(reply[1]), "little")


def is_enabled(appliance):
    return appliance.values("axis")["bus0.drive.Statusword"] & 0x6F == 0x27


def test_drive_is_enabled_in_csp_with_sync0_by_the_plant_file_alone(running):
    wait_until(lambda: is_enabled(running))
    values = running.values("axis")
    assert values["bus0.drive.Modes_of_operation_display"] == 8
    # The axis follows the set point of the plant file.
    first = values["bus0.drive.Position_actual_value"]
    wait_until(lambda: running.values("axis")["bus0.drive.Position_actual_value"] != first)
    assert registers(running, 0x0980, 2) == 0x0300
    assert registers(running, 0x09A0, 4) == 4_000_000
    assert registers(running, 0x0990, 8) % 4_000_000 == 250_000
    assert registers(running, 0x0420, 2) == 500


def test_drive_is_enabled_again_after_a_loss_of_power(running):
    wait_until(lambda: is_enabled(running))
    running.command("sim", "fault", "axis/bus0", "power", "slave=drive")
    wait_until(lambda: running.values("axis")["bus0.drive.state"] == 0)
    running.command("sim", "fault", "axis/bus0", "power", "slave=drive", "--end")
    wait_until(lambda: is_enabled(running))
    assert running.values("axis")["bus0.drive.Modes_of_operation_display"] == 8


def tool_row(appliance):
    (row,) = (
        row
        for row in json.loads(appliance.command("bus", "scan", "cell/bus0", "--json"))["slaves"]
        if row["name"] == "tool"
    )
    return row


def echoes(appliance, slave):
    """Return whether the input of a slave follows its output."""
    for value in (True, False):
        appliance.request("write", station="cell", values={f"bus0.{slave}.out": value})
        wait_until(lambda value=value: appliance.values("cell")[f"bus0.{slave}.echo"] is value)
    return True


def test_optional_slave_is_absent_and_is_plugged_in_and_out(running):
    wait_until(lambda: running.values("cell")["bus0.end.state"] == 8)
    assert echoes(running, "end")
    row = tool_row(running)
    assert (row["state"], row["is_absent"], row["fault"]) == (None, True, "")
    assert "absent" in running.command("bus", "scan", "cell/bus0")
    assert "not plugged in: tool (1004)" in running.command("bus", "diag", "cell/bus0")
    status = running.command("status")
    assert "1 absent" in status
    assert "tool" not in status
    for _ in range(2):
        running.command("sim", "fault", "cell/bus0", "cut", "slave=tool", "--end")
        wait_until(lambda: running.values("cell")["bus0.tool.state"] == 8)
        assert echoes(running, "tool")
        assert echoes(running, "end")
        sdo = json.loads(
            running.command("bus", "sdo", "read", "cell/bus0", "tool", "0x8000", "--json")
        )
        assert sdo["value"] == 7
        running.command("sim", "fault", "cell/bus0", "cut", "slave=tool")
        wait_until(lambda: running.values("cell")["bus0.tool.state"] == 0)
        wait_until(lambda: tool_row(running)["is_absent"])
        assert echoes(running, "end")


def test_refused_start_up_write_is_in_status_and_diag(running):
    wait_until(lambda: running.values("cell")["bus0.end.state"] == 8)
    text = "start-up write of 0x8000:00 in PS (data 63 00): "
    wait_until(lambda: text in flat(running.command("status")))
    assert text in flat(running.command("bus", "diag", "cell/bus0"))
    assert running.values("cell")["bus0.strict.state"] in {0, 1, 2}
    answer = running.command("bus", "state", "cell/bus0", "--json")
    (row,) = (each for each in json.loads(answer)["slaves"] if each["name"] == "strict")
    assert row["reason"].startswith(text)
    done = run_eapctl(running.runtime, "state", "cell/bus0/strict")
    assert done.stderr.startswith(f"cell/bus0/strict: {text}")


def flat(text):
    return " ".join(text.split())
