"""What a bus tells about its slaves, as plain data: who they are, how they are, their EEPROMs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from devicebus.errors import SiiError, WorkingCounterError
from devicebus.master import eeprom
from devicebus.master.diagnosis import diagnose
from devicebus.master.esm import read_status
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState, name_of, state_name
from devicebus.wire.sii import SiiProtocol
from eap.appliance.commands.bus_slave import Slave, SlaveBus

STATES = tuple(state.name for state in AlState)


def scan_rows(bus: SlaveBus) -> list[dict[str, Any]]:
    """Return who is there, in the order of the line; raises as a scan does."""
    return [_slave(slave) for slave in bus.scan()]


def state_rows(bus: SlaveBus, slave: str | None, target: str | None) -> list[dict[str, Any]]:
    """Return the states of one slave or of all, after bringing them to *target* if it is given.

    The state of one that does not answer is None.

    Raises:
        BusError: there is no such slave, or one refuses the state.
    """
    units: Sequence[Slave] = [bus.find(slave)] if slave is not None else bus.scan()
    if target is not None:
        bus.bring(units, AlState[target])
    return [_state(bus, unit) for unit in units]


def diagnosis(bus: SlaveBus, slave: str | None) -> dict[str, Any]:
    """Return states and error counters of one slave or of all, and where on the line errors start.

    Raises:
        BusError: there is no such slave.
    """
    names = {each.station: each.name for each in bus.scan()}
    wanted = {bus.find(slave).station} if slave is not None else {*names}
    found = bus.run(diagnose(list(names)), "diagnosis")
    fault = found.first_fault
    frames = bus.frame_counts()
    return {
        "frames": frames._asdict(),
        "starts_at": None
        if fault is None
        else {
            "slave": fault.station,
            "name": names[fault.station],
            "port": fault.port,
            "neighbour": fault.neighbour,
        },
        "slaves": [
            {
                "address": each.station,
                "name": names[each.station],
                "state": each.state,
                "code": each.code,
                "reason": each.text if each.code else "",
                "answers": each.answers,
                "ports": [msgspec.structs.asdict(port) for port in each.ports],
            }
            for each in found.slaves
            if each.station in wanted
        ],
    }


def read_eeprom(bus: SlaveBus, slave: str) -> tuple[dict[str, Any], bytes]:
    """Return what an EEPROM says in short, and all its octets.

    Raises:
        SiiError: it cannot be read.
    """
    unit = bus.find(slave)
    image = bus.run(eeprom.read_image(unit.station), f"slave {unit.station}: its EEPROM")
    content = sii.decode(image)
    fixed = content.fixed
    return {
        "address": unit.station,
        "name": content.name,
        "vendor": fixed.vendor,
        "product": fixed.product,
        "revision": fixed.revision,
        "serial": fixed.serial,
        "alias": fixed.alias,
        "intact": sii.is_intact(image),
        "octets": len(image),
        "categories": [
            {"type": kind, "octets": len(data)} for kind, data in sii.iter_categories(image)
        ],
    }, image


def write_eeprom(bus: SlaveBus, slave: str, image: bytes) -> dict[str, Any]:
    """Write a whole EEPROM, read it back, and let the slave load it.

    Raises:
        SiiError: no slave would start with this image, or the EEPROM does not take it.
    """
    if not sii.is_intact(image):
        raise SiiError("the check sum of this image is wrong: a slave would not load it")
    sii.decode(image)
    unit = bus.find(slave)
    what = f"slave {unit.station}: its EEPROM"
    bus.run(eeprom.write_image(unit.station, image), what)
    there = bus.run(eeprom.read_image(unit.station), what)
    if not image.startswith(there):
        raise SiiError(f"{what} holds something else than was written")
    bus.run(eeprom.reload(unit.station), what)
    return {"address": unit.station, "name": unit.name, "octets": len(image)}


def _slave(slave: Slave) -> dict[str, Any]:
    status = slave.status
    protocols = None if slave.protocols is None else SiiProtocol(slave.protocols & sum(SiiProtocol))
    return {
        "address": slave.station,
        "name": slave.name,
        "vendor": slave.vendor,
        "product": slave.product,
        "revision": slave.revision,
        "serial": slave.serial,
        "alias": slave.alias,
        "state": state_name(status.state | status.error << 4) if status.state else None,
        "code": status.code,
        "mailbox": None if protocols is None else [f"{str(each.name)[0]}oE" for each in protocols],
        "parent": slave.parent,
        "ports": list(slave.ports),
        "fault": slave.fault,
    }


def _state(bus: SlaveBus, slave: Slave) -> dict[str, Any]:
    row: dict[str, Any] = {"address": slave.station, "name": slave.name}
    try:
        status = bus.run(read_status(slave.station), f"slave {slave.station}: its state")
    except WorkingCounterError:
        return row | {"state": None, "code": 0, "reason": "it does not answer"}
    return row | {
        "state": state_name(status.state | status.error << 4),
        "code": status.code,
        "reason": name_of(status.code) if status.code else "",
    }
