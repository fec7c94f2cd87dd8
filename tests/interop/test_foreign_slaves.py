"""A drive that the plant file enables: KickCAT's slave stack, and our simulator, by one bus file.

KickCAT's network simulator runs its own slave stack and CiA 402 motor behind an Ethernet interface.
It is built from source, outside this repository; EAP_KICKCAT names the source folder with the
simulator in ``build/simulation``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.addresses import own_address
from tests.support.appliance import plants, wait_until
from tests.support.simulator import FAR, NEAR, veth_pair

SOURCE = Path(os.environ.get("EAP_KICKCAT", "/"))
SIMULATOR = SOURCE / "build/simulation/network_simulator"
DEVICES = SOURCE / "simulation/slave_configs"
DRIVE = DEVICES / "ecat402-drive.xml"

pytestmark = [
    pytest.mark.net,
    pytest.mark.root,
    pytest.mark.skipif(
        not (SIMULATOR.is_file() and DRIVE.is_file()),
        reason="needs KickCAT's network_simulator: EAP_KICKCAT names its source folder",
    ),
]

BUS = """
bus: foreign
slaves:
  - name: drive
    kind: esi
    esi: drive.xml
    product: 0x03B11002
    master:
      # The default PDO holds the mode of operation, this one leaves it to the start-up write.
      pdos: [0x1601, 0x1A00]
      dc: DCSync
      startup:
        - {sdo: "0x6060", value: 8}
        # The set point of this plant does not begin at the position of the axis.
        - {sdo: "0x6065", value: 0xFFFFFFFF, comment: no following error}
"""
PLANT = """
plant: foreign
stations:
  - name: axis
    net_id: 5.3.3.3.1.1
    cycle_us: 4000
    ports:
      - {name: eap0, kind: eap, interface: "udp://ADDRESS", net_id: 5.3.3.3.2.1}
      - {name: bus0, kind: bus, net_id: 5.3.3.3.3.1, INTERFACE}
    variables:
      shutdown: {type: UINT, default: 6}
      setpoint: DINT
    sources:
      setpoint: {kind: ramp, low: 0, high: 100000, period_ms: 60000}
    links:
      - {from: shutdown, to: OUT.Control_Word, from_bit: 1, to_bit: 1, bits: 2}
      - {from: IN.Status_Word, to: OUT.Control_Word, from_bit: 0, to_bit: 0, bits: 1}
      - {from: IN.Status_Word, to: OUT.Control_Word, from_bit: 1, to_bit: 3, bits: 1}
      - {from: setpoint, to: OUT.Position_set-point}
"""
OUT, IN = "bus0.drive.RPDO_2_mapping_parameter", "bus0.drive.TPDO_1_mapping_parameter"
INTERFACES = {
    "foreign": f'interface: "ethernet://{NEAR}", bus: drive.yaml',
    "simulated": 'interface: "sim://drive.yaml"',
}


def start_slave(stack):
    """Start the foreign slave; it ends with *stack*."""
    process = subprocess.Popen(
        [SIMULATOR, "-i", FAR, "-s", "ecat402-drive.json"], cwd=DEVICES, stdout=subprocess.DEVNULL
    )
    stack.callback(process.wait)
    stack.callback(process.kill)
    return process


def enabled(appliance):
    return appliance.values("axis")[f"{IN}.Status_Word"] & 0x6F == 0x27


def run_plant(farm, kind, bus=BUS):
    shutil.copy(DRIVE, farm.folder / "drive.xml")
    (farm.folder / "drive.yaml").write_text(bus)
    text = PLANT.replace("ADDRESS", own_address(0)).replace("INTERFACE", INTERFACES[kind])
    return farm.run(farm.write(text.replace("OUT.", f"{OUT}.").replace("IN.", f"{IN}.")))


@pytest.mark.parametrize("kind", INTERFACES)
def test_drive_is_enabled_in_csp_with_sync0_by_one_bus_file(kind):
    # The appliance is inside: it ends before its network does.
    with veth_pair(), ExitStack() as stack, plants() as farm:
        start_slave(stack)
        appliance = run_plant(farm, kind)
        wait_until(lambda: enabled(appliance))
        assert appliance.values("axis")[f"{IN}.Operation_mode_display"] == 8
        first = appliance.values("axis")[f"{IN}.Actual_position"]
        wait_until(lambda: appliance.values("axis")[f"{IN}.Actual_position"] > first)
        assigned = appliance.command("bus", "sdo", "read", "axis/bus0", "drive", "0x1C12:1")
        assert "0x1601" in assigned
        rows = [(4, 1001, 0x0980, bytes(2).hex(), 0), (4, 1001, 0x09A0, bytes(4).hex(), 0)]
        replies = appliance.request("bus_transfer", station="axis", port="bus0", datagrams=rows)
        assert [each[1] for each in replies["replies"]] == [
            "0003",
            (4_000_000).to_bytes(4, "little").hex(),
        ]


def test_foreign_drive_is_configured_again_after_a_loss_of_power():
    with veth_pair(), ExitStack() as stack, plants() as farm:
        process = start_slave(stack)
        appliance = run_plant(farm, "foreign")
        wait_until(lambda: enabled(appliance))
        process.kill()
        wait_until(lambda: appliance.values("axis")["bus0.drive.state"] == 0)
        start_slave(stack)
        wait_until(lambda: appliance.values("axis")["bus0.drive.state"] == 8)
        wait_until(lambda: enabled(appliance))
        assert appliance.values("axis")[f"{IN}.Operation_mode_display"] == 8


def test_write_that_the_foreign_drive_refuses_is_named():
    wrong = BUS.replace("startup:", 'startup:\n        - {sdo: "0x5FFF", data: "01"}')
    with veth_pair(), ExitStack() as stack, plants() as farm:
        start_slave(stack)
        appliance = run_plant(farm, "foreign", wrong)
        text = "start-up write of 0x5FFF:00 in PS (data 01): object does not exist (0x06020000)"
        wait_until(lambda: text in " ".join(appliance.command("status").split()))
