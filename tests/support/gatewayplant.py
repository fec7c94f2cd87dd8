"""A plant whose stations serve the gateway, with slaves of every sort behind it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tests.support.appliance import Appliance, plants, wait_until

DRIVE, COUPLER, SENSOR, MUTE, LAST = 1001, 1002, 1003, 1004, 1005
"""Every protocol; no mailbox; only CoE; takes nothing any more; only CoE."""
FILE = b"firmware 1.0 of a simulated drive"
BUS = """\
bus: gateway
slaves:
  - name: drive
    kind: drive
    product: 0x5621
    mailbox: {size: 1024, coe: true, soe: true, foe: true, voe: true, eoe: true, aoe: true}
    files:
      - {name: firmware.bin, max_size: 4194304, content: "firmware 1.0 of a simulated drive"}
      - {name: parameters.bin, max_size: 4194304}
  - {name: coupler, kind: coupler, product: 1, mailbox: null}
  - name: sensor
    kind: analogue
    product: 3
    inputs: [{name: pressure, type: UINT, value: 1013}]
    objects: [{index: 0x8001, name: Calibration, type: BLOCK(2048)}]
  - {name: mute, kind: digital, product: 4, inputs: [{name: in1}]}
  - {name: last, kind: digital, product: 5, inputs: [{name: in1}]}
"""


def plant_of(address: str, more: str = "") -> str:
    """One station at *address* with such a bus; *more* is of the station."""
    return f"""\
plant: gateway
defaults: {{cycle_us: 10000}}
stations:
  - name: mill
    net_id: {address}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{address}", net_id: {address}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://gateway.yaml", net_id: {address}.3.1}}
{more}"""


@contextmanager
def gateway_plant(address: str) -> Iterator[Appliance]:
    """Run it until its bus is in OP and *mute* is silent."""
    with plants() as farm:
        farm.write(BUS, "gateway.yaml")
        appliance = farm.run(farm.write(plant_of(address)))
        wait_until(lambda: state_of(appliance) == 8)
        appliance.command("sim", "fault", "mill/bus0", "mailbox", "slave=mute")
        yield appliance


def state_of(appliance: Appliance) -> int:
    """Return the state of the bus."""
    answer = appliance.request("read", station="mill", names=["bus0.state"])
    return int(answer["values"]["bus0.state"])
