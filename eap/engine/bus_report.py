"""Description of a bus for services: the whole as one record, and its changes as messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from msgspec.structs import asdict

from devicebus.master.bus import BusSlave
from devicebus.master.findings import NO_ANSWER
from devicebus.master.master import why_closed
from devicebus.master.scan import FoundSlave
from eap.engine.engine_bus import WHOLE_BUS, EngineBus
from eap.runtime.bus_errors import to_record
from eap.runtime.engine_messages import (
    BusChange,
    BusReport,
    EmergencyReport,
    LockState,
    PortErrorReport,
    RingState,
    SlaveDescription,
    SlaveReport,
)


def report_bus(bus: EngineBus, now_ns: int) -> BusReport:
    """Return the report of *bus*, with the expected slaves until the real ones are known."""
    stats = bus.master.stats()
    bus_slaves = bus.master.slaves.values()
    presets = link_presets(bus_slaves)
    slaves = (
        [_report(bus, bus_slave, presets, now_ns) for bus_slave in bus_slaves]
        if bus_slaves
        else [SlaveReport(**asdict(each)) for each in expected_slaves(bus)]
    )
    cycle = stats.cycle
    silence = bus.faults.last(WHOLE_BUS)
    return BusReport(
        is_up=bus.is_up,
        fault=bus.fault,
        slaves=tuple(slaves),
        refused=tuple(_refused_slave(each) for each in bus.refused),
        silent_since_ns=now_ns - silence.since_ns if silence.text else None,
        silent_until_ns=None if silence.until_ns is None else now_ns - silence.until_ns,
        frames_sent=stats.link.sent,
        frames_received=stats.link.received,
        frames_late=stats.link.late,
        frames_lost=stats.link.lost,
        frames_retried=stats.link.retried,
        timeout_ns=stats.link.timeout_ns,
        round_trip_ns=stats.link.round_trip_ns,
        cycles=cycle.cycles if cycle else 0,
        cycles_good=cycle.good if cycle else 0,
        wkc_errors=cycle.wkc_errors if cycle else 0,
        cycles_late=cycle.late if cycle else 0,
        cycles_lost=cycle.lost if cycle else 0,
        cycles_skipped=cycle.skipped if cycle else 0,
        expected_wkc=cycle.expected_wkc if cycle else 0,
        received_wkc=cycle.received_wkc if cycle else 0,
        trip_ns=cycle.trip_ns if cycle else 0,
        max_trip_ns=cycle.max_trip_ns if cycle else 0,
        ring=_ring(bus, now_ns),
        lock=_lock(bus, now_ns),
    )


def _lock(bus: EngineBus, now_ns: int) -> LockState | None:
    if bus.master.lock is None or bus.master.cycle is None:
        return None
    report = bus.master.lock.report()
    return LockState(
        reference=bus.master.reference,
        is_locked=report.is_locked,
        offset_ns=report.offset_ns,
        drift_ppb=report.drift_ppb,
        lead_ns=report.lead_ns,
        late=report.late,
        early=report.early,
        # Simulated slaves get a frame when their process runs, which says nothing about the cycle.
        fault_ns=None if report.fault_ns is None or bus.is_simulated else now_ns - report.fault_ns,
    )


def _ring(bus: EngineBus, now_ns: int) -> RingState | None:
    if bus.master.ring is None:
        return None
    report = bus.master.ring.report()
    return RingState(
        is_whole=report.is_whole,
        ends=bus.master.cut_ends if report.cut_ns is not None else None,
        silent=report.silent,
        cuts=report.cuts,
        cut_ns=None if report.cut_ns is None else now_ns - report.cut_ns,
        mended_ns=None if report.mended_ns is None else now_ns - report.mended_ns,
    )


def link_presets(slaves: Collection[BusSlave]) -> dict[int, int]:
    """Return by position the ports that led to other slaves when these were found (ETG.1510)."""
    presets: dict[int, int] = {}
    for slave in slaves:
        node = slave.found.node
        # A link is between two slaves: each of them has a port that is expected to be connected.
        ends = [(slave.found.position, node.entry_port)]
        if node.parent is not None:
            ends.append((node.parent, node.parent_port))
        for position, port in ends:
            if port:  # the standard has no bits for port 0
                presets[position] = presets.get(position, 0) | 0x11 << port - 1
    return presets


def describe_slave(bus: EngineBus, slave: BusSlave, presets: Mapping[int, int]) -> SlaveDescription:
    """Return the description of a slave that was found; *presets* as link_presets returns them."""
    identity, sii = slave.found.identity, slave.found.sii
    counts = bus.faults.counts(slave.station)
    sizes = slave.mailbox.sizes if slave.mailbox is not None else None
    return SlaveDescription(
        station=slave.station,
        name=slave.name,
        vendor=identity.vendor,
        product=identity.product,
        revision=identity.revision,
        serial=identity.serial,
        alias=slave.found.alias,
        state=slave.al_state,
        target=int(slave.target),
        to_slave=sizes.to_slave if sizes else 0,
        to_master=sizes.to_master if sizes else 0,
        mailbox_fault=None if sizes else to_record(why_closed(slave)),
        protocols=int(sii.fixed.protocols),
        order=sii.string(sii.general.order) if sii.general else "",
        usual_to_slave=sii.fixed.receive_size,
        usual_to_master=sii.fixed.send_size,
        port_physics=sii.general.port_physics if sii.general else 0,
        link_preset=presets.get(slave.found.position, 0),
        losses=counts.losses,
        departures=counts.departures,
        al_code=counts.al_code,
        fault=_fault(bus, slave),
        is_optional=slave.is_optional,
        is_absent=slave.is_absent,
    )


def _report(
    bus: EngineBus, slave: BusSlave, presets: Mapping[int, int], now_ns: int
) -> SlaveReport:
    last = bus.faults.last(slave.station)
    emergencies = bus.faults.emergencies.of(slave.station)
    stats = slave.mailbox.stats() if slave.mailbox is not None else None
    missed_ns = None if stats is None else stats.unanswered_ns
    return SlaveReport(
        **asdict(describe_slave(bus, slave, presets)),
        past_fault=last.text if last.until_ns is not None else "",
        since_ns=now_ns - last.since_ns if last.text else None,
        until_ns=None if last.until_ns is None else now_ns - last.until_ns,
        mailbox_timeouts=0 if stats is None else stats.unanswered,
        mailbox_timeout_ns=None if missed_ns is None else now_ns - missed_ns,
        mailbox_late=0 if stats is None else stats.late,
        forwarded=0 if stats is None else stats.forwarded,
        forward_dropped=0 if stats is None else stats.forward_dropped,
        port_errors=tuple(
            PortErrorReport(port, now_ns - seen.since_ns, now_ns - seen.until_ns)
            for port, seen in bus.master.port_errors.of(slave.station).items()
        ),
        emergencies=emergencies.number,
        latest_emergencies=tuple(
            EmergencyReport(
                ago_ns=now_ns - each.at_ns,
                protocol=each.protocol,
                drive=each.drive,
                code=each.code,
                register=each.register,
                data=each.data.hex(),
            )
            for each in emergencies.latest
        ),
    )


def _fault(bus: EngineBus, slave: BusSlave) -> str:
    """Return the reason why a slave is not in its target state at this moment."""
    fault = bus.faults.of(slave.station)
    if bus.master.lacks_group(slave):
        return f"it is absent, although others of its group {slave.config.group} are there"
    if fault == NO_ANSWER and slave.is_busy and slave.state is not None:
        return f"it answers again and is on its way to {slave.target.name}"
    return fault


def expected_slaves(bus: EngineBus) -> list[SlaveDescription]:
    """Return the slaves of the plant file, for a bus whose slaves have not been found yet."""
    return [
        SlaveDescription(
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
        for slave in bus.spec.slaves
    ]


def _refused_slave(found: FoundSlave) -> SlaveReport:
    """Return the report of a slave on a bus that is not as configured."""
    identity, status = found.identity, found.al_status
    return SlaveReport(
        station=found.station,
        name=found.name,
        vendor=identity.vendor,
        product=identity.product,
        revision=identity.revision,
        serial=identity.serial,
        alias=found.alias,
        state=status.state | status.error << 4,
        target=0,
        protocols=int(found.sii.fixed.protocols),
        fault=found.fault,
    )


class BusPublisher:
    """Sends the slaves that have changed since the message that was sent last.

    A message that cannot be sent is not lost: its changes are part of the next one.

    Args:
        number: Of the bus in messages.
        bus: The bus.
        send: Sends a message; returns False if there is no room for it.
    """

    def __init__(self, number: int, bus: EngineBus, send: Callable[[BusChange], bool]) -> None:
        self._number = number
        self._bus = bus
        self._send = send
        self._sent: tuple[object, ...] = ()
        self._bus_slaves: Mapping[int, BusSlave] | None = None
        self._presets: Mapping[int, int] = {}
        self._changes = 0

    def reset(self) -> None:
        """Send all slaves next, because the receiver was replaced."""
        self._sent, self._bus_slaves = (), None

    def flush(self) -> None:
        """Send the changes, if there are any."""
        bus, master = self._bus, self._bus.master
        revision = bus.revision
        # Nothing has changed, which is the case in nearly every call.
        if revision == self._sent:
            return
        bus.faults.handle_events(master)  # a change that they bring is counted already
        # The mapping is replaced by each scan: its identity tells a new set of slaves.
        bus_slaves = master.slaves
        if bus_slaves is self._bus_slaves:
            presets = self._presets
            changed = [
                bus_slave for bus_slave in bus_slaves.values() if bus_slave.revision > self._changes
            ]
        else:
            presets = link_presets(bus_slaves.values())
            changed = list(bus_slaves.values())
        slaves = [describe_slave(bus, bus_slave, presets) for bus_slave in changed]
        if not bus_slaves:
            slaves = expected_slaves(bus)
        message = BusChange(
            bus=self._number,
            is_up=bus.is_up,
            fault=bus.fault,
            stations=tuple(bus_slaves) or tuple(slave.station for slave in slaves),
            slaves=tuple(slaves),
            is_silent=master.is_lost,
        )
        if self._send(message):
            self._sent, self._bus_slaves = revision, bus_slaves
            self._presets, self._changes = presets, master.changes
