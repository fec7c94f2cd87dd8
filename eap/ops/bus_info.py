"""Slaves of a bus as typed results: identity, state, diagnosis, EEPROM."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec

from devicebus.errors import SiiError, WorkingCounterError
from devicebus.master import eeprom
from devicebus.master.diagnosis import (
    BusDiagnosis,
    PortErrors,
    SlaveDiagnosis,
    clear_counters,
    diagnose,
)
from devicebus.master.esm import read_status
from devicebus.master.findings import (
    BusFinding,
    SlaveView,
    describe_trouble,
    find_causes,
    find_silence,
    without_slave,
)
from devicebus.master.procedure import Procedure, Sleep
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState, name_of, state_name
from devicebus.wire.sii import SiiProtocol
from eap.ops.bus_session import Slave, SlaveBus, choose
from eap.runtime.bus_status import (
    EmergencyRow,
    FindingRow,
    FrameCounts,
    NamedSlave,
    emergency_rows,
    find_emergencies,
    find_eoe_faults,
    find_lock_faults,
    finding_row,
)
from eap.runtime.engine_messages import EoeReport, LockState, SlaveReport

_TRIES = 3
_PAUSE_NS = 100_000_000
STATES = tuple(state.name for state in AlState)


class ScannedSlave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave of a scan."""

    address: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    alias: int
    state: str | None
    """None if it does not answer."""
    code: int
    mailbox: list[str] | None
    """Protocols; None if they are not known."""
    parent: int | None
    ports: tuple[int, ...]
    fault: str
    is_absent: bool = False
    """True for an optional slave of a running station that is not plugged in."""


class BusScan(msgspec.Struct, frozen=True):
    """``eapctl bus scan``."""

    slaves: list[ScannedSlave]
    fault: str = ""
    """Differences of a bus that is not as configured, a line for each."""
    expected: list[NamedSlave] = []
    """Configured slaves of such a bus."""


class SlaveStateRow(msgspec.Struct, frozen=True):
    """AL state of one slave; None if it does not answer."""

    address: int
    name: str
    state: str | None
    code: int
    reason: str
    is_absent: bool = False


class SlaveStates(msgspec.Struct, frozen=True):
    """``eapctl bus state``."""

    slaves: list[SlaveStateRow]


class ErrorOrigin(msgspec.Struct, frozen=True):
    """Port at which errors start; the neighbour is None for the master or an open port."""

    slave: int
    name: str
    port: int
    neighbour: int | None


class DiagnosedSlave(msgspec.Struct, frozen=True):
    """State and error counters of one slave."""

    address: int
    name: str
    state: str
    code: int
    reason: str
    answers: bool
    ports: tuple[PortErrors, ...]
    emergencies: int = 0
    latest_emergencies: list[EmergencyRow] = []
    """The latest, oldest first."""
    mailbox_timeouts: int = 0
    mailbox_late: int = 0


class Diagnosis(msgspec.Struct, frozen=True):
    """``eapctl bus diag``."""

    frames: FrameCounts
    findings: list[FindingRow]
    starts_at: ErrorOrigin | None
    slaves: list[DiagnosedSlave]
    eoe: EoeReport | None = None
    absent: list[NamedSlave] = []
    """Optional slaves that are not plugged in."""
    lock: LockState | None = None
    """Lock of the station's cycle to the clocks of the bus; None if it runs free."""


class CounterReset(msgspec.Struct, frozen=True):
    """``eapctl bus diag --reset``: stations whose error counters were cleared."""

    reset: list[int]


class EepromCategory(msgspec.Struct, frozen=True):
    """Type and length of one category."""

    type: int
    octets: int


class EepromContent(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl bus sii dump``; *data* is the whole content in hexadecimal digits."""

    address: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    alias: int
    intact: bool
    octets: int
    categories: list[EepromCategory]
    data: str


class WrittenEeprom(msgspec.Struct, frozen=True):
    """``eapctl bus sii write``."""

    address: int
    name: str
    octets: int


def scan_slaves(bus: SlaveBus) -> BusScan:
    """Return all slaves in the order of the line; raises as a scan does.

    Those of a running station that are not as configured are those that its master has found.
    """
    if (mismatch := bus.mismatch()) is not None:
        expected = [NamedSlave(each.station, each.name) for each in mismatch.expected]
        return BusScan([_scanned(each) for each in mismatch.found], mismatch.fault, expected)
    return BusScan([_scanned(slave) for slave in bus.scan()])


def fault_lines(slaves: Iterable[ScannedSlave]) -> list[str]:
    """Return a line for each fault of scanned *slaves*."""
    faults: dict[str, list[str]] = {}
    for slave in slaves:
        if slave.fault:
            faults.setdefault(slave.fault, []).append(f"{slave.name} ({slave.address})")
    return [describe_trouble(names, fault) for fault, names in faults.items()]


def slave_states(bus: SlaveBus, slave: str | None, target: str | None) -> SlaveStates:
    """Return the states of one slave or of all, after bringing them to *target* if it is given.

    The state of one that does not answer is None.

    Raises:
        BusError: there is no such slave, or one refuses the state.
    """
    units: Sequence[Slave] = [bus.find(slave)] if slave is not None else bus.scan()
    if target is not None:
        bus.bring([unit for unit in units if not unit.is_absent], AlState[target])
        # Faults of the time before: a slave that does not reach the target raises.
        units = [msgspec.structs.replace(unit, fault="") for unit in units]
    return SlaveStates([_state(bus, unit) for unit in units])


def diagnosis(bus: SlaveBus, slave: str | None, now_s: float) -> Diagnosis:
    """Return states, error counters, and present and past faults of one slave or of all.

    Args:
        bus: Reaches the slaves.
        slave: Name or station address of the one that is shown; None for all.
        now_s: Unix time, for the times of findings.

    Raises:
        BusError: there is no such slave.
    """
    all_known = bus.known()
    known = [each for each in all_known if not each.is_absent]
    absent = [each for each in all_known if each.is_absent]
    names = {each.station: each.name for each in all_known}
    units = {each.station: each for each in known}
    wanted = {choose(all_known, slave).station} if slave is not None else {*names}
    found = bus.run(_diagnose(list(units)), "diagnosis")
    views = [_view(each, there) for each, there in zip(known, found.slaves, strict=True)]
    history, reports = bus.history(), bus.reports()
    if found.is_silent:
        causes = [find_silence(views, history.silent_since_ns if history is not None else None)]
    else:
        causes = [
            *find_causes(views, found, history),
            *find_emergencies(reports.values()),
            *find_lock_faults(bus.lock_state()),
            *find_eoe_faults(bus.eoe_report()),
        ]
    # A fault of an absent slave: others of its hot-connect group are there.
    causes += [
        BusFinding(what=f"{each.name} ({each.station}): {each.fault}", slaves=(each.station,))
        for each in absent
        if each.fault
    ]
    fault = found.first_fault
    return Diagnosis(
        frames=bus.frame_counts(),
        eoe=bus.eoe_report(),
        lock=bus.lock_state(),
        findings=[finding_row(each, names, now_s) for each in causes],
        starts_at=None
        if fault is None
        else ErrorOrigin(fault.station, names[fault.station], fault.port, fault.neighbour),
        slaves=[
            DiagnosedSlave(
                address=each.station,
                name=names[each.station],
                state=each.state,
                code=each.code,
                reason=each.text if each.code else "",
                answers=each.answers,
                ports=each.ports,
                mailbox_timeouts=units[each.station].mailbox_timeouts,
                mailbox_late=units[each.station].mailbox_late,
                **_emergencies(reports.get(each.station), now_s),
            )
            for each in found.slaves
            if each.station in wanted
        ],
        absent=[NamedSlave(each.station, each.name) for each in absent if each.station in wanted],
    )


def _emergencies(report: SlaveReport | None, now_s: float) -> dict[str, Any]:
    if report is None:
        return {}
    rows = emergency_rows(report, now_s)
    return {"emergencies": report.emergencies, "latest_emergencies": rows}


def _diagnose(stations: Sequence[int]) -> Procedure[BusDiagnosis]:
    """Read registers of slaves, again if nothing came back: a frame that is lost is no silence."""
    for _ in range(_TRIES - 1):
        found = yield from diagnose(stations)
        if not found.is_silent:
            return found
        yield Sleep(_PAUSE_NS)
    return (yield from diagnose(stations))


def reset_diagnosis(bus: SlaveBus) -> CounterReset:
    """Clear the error counters of all slaves, and forget faults that are over."""
    stations = [each.station for each in bus.known() if not each.is_absent]
    bus.run(clear_counters(stations), "clearing error counters")
    bus.forget()
    return CounterReset(stations)


def _view(slave: Slave, there: SlaveDiagnosis) -> SlaveView:
    """Return a slave as its registers show it, with why it is not where its master keeps it."""
    trouble = ""
    if there.answers and there.state.endswith("ERROR"):
        trouble = slave.fault or f"in {there.state}: {there.text} (0x{there.code:04X})"
    elif there.answers and slave.target and there.state != state_name(slave.target):
        trouble = slave.fault or f"in {there.state}, not yet in {state_name(slave.target)}"
    return SlaveView(slave.station, slave.name, there.answers, trouble, slave.since_ns)


def read_eeprom(bus: SlaveBus, slave: str) -> EepromContent:
    """Return the content of an EEPROM.

    Raises:
        SiiError: it cannot be read.
    """
    unit = bus.find(slave)
    image = bus.run(eeprom.read_image(unit.station), f"slave {unit.station}: its EEPROM")
    content = sii.decode(image)
    fixed = content.fixed
    return EepromContent(
        address=unit.station,
        name=content.name,
        vendor=fixed.vendor,
        product=fixed.product,
        revision=fixed.revision,
        serial=fixed.serial,
        alias=fixed.alias,
        intact=sii.is_intact(image),
        octets=len(image),
        categories=[EepromCategory(kind, len(data)) for kind, data in sii.iter_categories(image)],
        data=image.hex(),
    )


def write_eeprom(bus: SlaveBus, slave: str, image: bytes) -> WrittenEeprom:
    """Write a whole EEPROM, read it back, and request the slave to load it.

    Raises:
        SiiError: no slave would start with this image, or the EEPROM rejects it.
    """
    # Before anything is written: a slave with a wrong checksum does not load its configuration.
    if not sii.is_intact(image):
        raise SiiError("wrong checksum in the image: the slave would not load it")
    sii.decode(image)
    unit = bus.find(slave)
    what = f"slave {unit.station}: its EEPROM"
    bus.run(eeprom.write_image(unit.station, image), what)
    there = bus.run(eeprom.read_image(unit.station), what)
    # The image may have padding behind the last category, which is not read back.
    if not image.startswith(there):
        raise SiiError(f"{what} differs from the written image")
    bus.run(eeprom.reload(unit.station), what)
    return WrittenEeprom(unit.station, unit.name, len(image))


def _scanned(slave: Slave) -> ScannedSlave:
    status = slave.status
    protocols = None if slave.protocols is None else SiiProtocol(slave.protocols & sum(SiiProtocol))
    return ScannedSlave(
        address=slave.station,
        name=slave.name,
        vendor=slave.vendor,
        product=slave.product,
        revision=slave.revision,
        serial=slave.serial,
        alias=slave.alias,
        # Bit 4 is the error bit of the AL status (ESC 0x0130).
        state=state_name(status.state | status.error << 4) if status.state else None,
        code=status.code,
        mailbox=None if protocols is None else [each.title for each in protocols],
        parent=slave.parent,
        ports=slave.ports,
        fault=slave.fault,
        is_absent=slave.is_absent,
    )


def _state(bus: SlaveBus, slave: Slave) -> SlaveStateRow:
    if slave.is_absent:
        return SlaveStateRow(slave.station, slave.name, None, 0, "", is_absent=True)
    try:
        status = bus.run(read_status(slave.station), f"slave {slave.station}: its state")
    except WorkingCounterError:
        return SlaveStateRow(slave.station, slave.name, None, 0, "it does not answer")
    reason = name_of(status.code) if status.code else without_slave(slave.fault)
    state = state_name(status.state | status.error << 4)
    return SlaveStateRow(slave.station, slave.name, state, status.code, reason)
