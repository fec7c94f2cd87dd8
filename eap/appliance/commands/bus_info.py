"""What a bus tells about its slaves, as plain data: who they are, how they are, their EEPROMs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from devicebus.errors import SiiError, WorkingCounterError
from devicebus.master import eeprom
from devicebus.master.diagnosis import BusDiagnosis, SlaveDiagnosis, clear_counters, diagnose
from devicebus.master.esm import read_status
from devicebus.master.findings import SlaveView, describe_trouble, find_causes, find_silence
from devicebus.master.procedure import Procedure, Sleep
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState, name_of, state_name
from devicebus.wire.sii import SiiProtocol
from eap.appliance.bus_findings import finding_row
from eap.appliance.commands.bus_slave import Slave, SlaveBus, choose

_TRIES = 3
_PAUSE_NS = 100_000_000
STATES = tuple(state.name for state in AlState)


def scan_rows(bus: SlaveBus) -> list[dict[str, Any]]:
    """Return who is there, in the order of the line; raises as a scan does."""
    return [_slave(slave) for slave in bus.scan()]


def fault_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what is wrong with the slaves of a scan, one line for each fault."""
    faults: dict[str, list[str]] = {}
    for row in rows:
        if row["fault"]:
            faults.setdefault(row["fault"], []).append(f"{row['name']} ({row['address']})")
    return [describe_trouble(names, fault) for fault, names in faults.items()]


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


def diagnosis(bus: SlaveBus, slave: str | None, now_s: float) -> dict[str, Any]:
    """Return states and error counters of one slave or of all, and what is or was wrong.

    Args:
        bus: Reaches the slaves.
        slave: Name or station address of the one that is shown; None for all.
        now_s: Unix time, for the times of findings.

    Raises:
        BusError: there is no such slave.
    """
    known = bus.known()
    names = {each.station: each.name for each in known}
    wanted = {choose(known, slave).station} if slave is not None else {*names}
    found = bus.run(_diagnose(list(names)), "diagnosis")
    views = [_view(each, there) for each, there in zip(known, found.slaves, strict=True)]
    history = bus.history()
    if found.is_silent:
        causes = [find_silence(views, history.silent_since_ns if history is not None else None)]
    else:
        causes = find_causes(views, found, history)
    frames = bus.frame_counts()
    fault = found.first_fault
    return {
        "frames": frames._asdict(),
        "findings": [finding_row(each, names, now_s) for each in causes],
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


def _diagnose(stations: Sequence[int]) -> Procedure[BusDiagnosis]:
    """Read registers of slaves, again if nothing came back: a frame that is lost is no silence."""
    for _ in range(_TRIES - 1):
        found = yield from diagnose(stations)
        if not found.is_silent:
            return found
        yield Sleep(_PAUSE_NS)
    return (yield from diagnose(stations))


def reset_diagnosis(bus: SlaveBus) -> dict[str, Any]:
    """Clear the error counters of all slaves, and forget faults that are over."""
    stations = [each.station for each in bus.known()]
    bus.run(clear_counters(stations), "clearing error counters")
    bus.forget()
    return {"reset": stations}


def _view(slave: Slave, there: SlaveDiagnosis) -> SlaveView:
    """Return a slave as its registers show it, with why it is not where its master keeps it."""
    trouble = ""
    if there.answers and there.state.endswith("ERROR"):
        trouble = slave.fault or f"in {there.state}: {there.text} (0x{there.code:04X})"
    elif there.answers and slave.target and there.state != state_name(slave.target):
        trouble = slave.fault or f"in {there.state}, not yet in {state_name(slave.target)}"
    return SlaveView(slave.station, slave.name, there.answers, trouble, slave.since_ns)


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
