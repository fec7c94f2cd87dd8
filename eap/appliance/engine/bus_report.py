"""How a bus is, for services: slaves, faults and counters as one record."""

from __future__ import annotations

from devicebus.master.bus import Unit
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.appliance.engine.engine_bus import EngineBus
from eap.pd.spec import BusSlaveSpec


def report_bus(bus: EngineBus) -> BusReport:
    """Return what *bus* knows now; before its slaves are known, those that are expected."""
    stats = bus.master.stats()
    units = bus.master.units.values()
    slaves = (
        [_found(unit, bus.faults.of(unit.station)) for unit in units]
        if units
        else [_expected(slave) for slave in bus.spec.slaves]
    )
    cycle = stats.cycle
    return BusReport(
        is_up=bus.is_up,
        fault=bus.fault,
        slaves=tuple(slaves),
        frames_sent=stats.link.sent,
        frames_lost=stats.link.lost,
        cycles=cycle.cycles if cycle else 0,
        cycles_good=cycle.good if cycle else 0,
        wkc_errors=cycle.wkc_errors if cycle else 0,
        cycles_lost=cycle.lost if cycle else 0,
        expected_wkc=cycle.expected_wkc if cycle else 0,
        received_wkc=cycle.received_wkc if cycle else 0,
        trip_ns=cycle.trip_ns if cycle else 0,
        max_trip_ns=cycle.max_trip_ns if cycle else 0,
    )


def _found(unit: Unit, fault: str) -> SlaveReport:
    identity = unit.found.identity
    sizes = unit.mailbox.sizes if unit.mailbox is not None else None
    return SlaveReport(
        station=unit.station,
        name=unit.name,
        vendor=identity.vendor,
        product=identity.product,
        revision=identity.revision,
        serial=identity.serial,
        alias=unit.found.alias,
        state=0 if unit.is_lost else int(unit.state),
        target=int(unit.target),
        to_slave=sizes.to_slave if sizes else 0,
        to_master=sizes.to_master if sizes else 0,
        protocols=int(unit.found.sii.fixed.protocols),
        fault=fault,
    )


def _expected(slave: BusSlaveSpec) -> SlaveReport:
    return SlaveReport(
        station=slave.station,
        name=slave.name,
        vendor=slave.vendor,
        product=slave.product,
        revision=slave.revision or 0,
        serial=slave.serial or 0,
        alias=slave.alias or 0,
        state=0,
        target=0,
        fault="it has not been found yet",
    )
