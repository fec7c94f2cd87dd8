"""State changes of a slave, with the registers that each state needs (ETG.1000.6)."""

from __future__ import annotations

from collections.abc import Sequence

from devicebus.errors import BusError, SiiError
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.clocks import synchronize
from devicebus.master.configuration import (
    prepare_registers,
    prepare_safeop,
    run_writes,
    state_timeout_ns,
    transition_of,
)
from devicebus.master.cycle import Participation
from devicebus.master.esm import acknowledge, change_state, path
from devicebus.master.image import MAX_FMMUS, SlaveLayout
from devicebus.master.mailboxes import MailboxArea, configure
from devicebus.master.procedure import Procedure, Sleep, write
from devicebus.master.scan import FoundSlave, count_slaves, find_ring_end, read_topology
from devicebus.wire.alstatus import WITH_PROCESS_DATA, AlState
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.sii import SiiFixed
from eap.errors import EapError
from eap.od.slave_config import Transition

MAX_SYNC_MANAGERS = 16
LOOP_CONTROL = Register.DL_CONTROL + 1
"""Loop control of the ports, two bits each; 0 opens each port with a link."""
_ALWAYS_CLOSED = 3


def standard_mailbox(fixed: SiiFixed) -> MailboxArea:
    """Return the mailbox area for PREOP, SAFEOP and OP."""
    return MailboxArea(fixed.receive_offset, fixed.receive_size, fixed.send_offset, fixed.send_size)


def boot_mailbox(fixed: SiiFixed) -> MailboxArea:
    """Return the mailbox area for BOOT."""
    return MailboxArea(
        fixed.boot_receive_offset,
        fixed.boot_receive_size,
        fixed.boot_send_offset,
        fixed.boot_send_size,
    )


def clear(station: int, *, fmmus: int, sync_managers: int) -> Procedure[None]:
    """Switch off all sync managers and FMMUs of a slave in INIT.

    Raises WorkingCounterError if it does not answer.
    """
    if sync_managers:
        octets = bytes(SyncManager.SIZE * min(sync_managers, MAX_SYNC_MANAGERS))
        yield from write(station, Register.SYNC_MANAGER, octets, "sync managers")
    if fmmus:
        yield from write(station, Register.FMMU, bytes(Fmmu.SIZE * min(fmmus, MAX_FMMUS)), "FMMUs")


def set_process_data(layout: SlaveLayout) -> Procedure[None]:
    """Write the sync managers and FMMUs of a slave in PREOP.

    Raises WorkingCounterError if it does not answer.
    """
    for number, manager in layout.sync_managers:
        at = Register.SYNC_MANAGER + SyncManager.SIZE * number
        yield from write(layout.station, at, manager.encode(), f"sync manager {number}")
    if layout.fmmus:
        octets = b"".join(fmmu.encode() for fmmu in layout.fmmus)
        yield from write(layout.station, Register.FMMU, octets, "FMMUs")


def bring(bus: BusState, slave: BusSlave, target: AlState) -> Procedure[None]:
    """Bring a slave to *target*, step by step.

    Raises:
        AlStatusError, StateTimeoutError: the slave refuses, or takes too long.
        SiiError: its EEPROM cannot be read, so its configuration is unknown.
        BusError: it refuses a part of its configuration.
        WorkingCounterError: the slave does not answer.
    """
    if slave.found.fault:
        raise SiiError(slave.found.fault)
    slave.state = current = yield from acknowledge(slave.station)
    if current is AlState.INIT:
        bus.close_mailbox(slave)
    for step in path(current, target):
        yield from _prepare(bus, slave, current, step)
        limit_ns = state_timeout_ns(slave.config, current, step)
        yield from change_state(slave.station, step, timeout_ns=limit_ns)
        slave.is_configured = False
        before, slave.state, current = current, step, step
        if step is AlState.INIT:
            bus.close_mailbox(slave)  # only now: a slave that refused INIT keeps its mailbox
        if before in WITH_PROCESS_DATA and step not in WITH_PROCESS_DATA:
            yield from _end_process_data(bus, slave)
        slave.is_set_up = step in WITH_PROCESS_DATA
        if step in WITH_PROCESS_DATA:
            bus.set_participation(slave, Participation.ACTIVE)
        elif step is AlState.BOOT:
            bus.open_mailbox(slave, boot_mailbox(slave.found.sii.fixed))
        elif step is AlState.PREOP and slave.mailbox is None:
            yield from _begin_preop(bus, slave)
    slave.state = target


def set_clocks(bus: BusState, *, only: frozenset[int] | None = None) -> Procedure[None]:
    """Set the clocks of all slaves, or *only* of the given stations."""
    present = [slave.found for slave in bus.slaves.values() if not slave.is_lost]
    ring = bus.ring
    if ring is None:
        yield from _synchronize(bus, present, only)
        return
    # A frame that passes a whole ring never comes back through a port, so there would be no round
    # trip to measure: the last port is closed meanwhile, which makes the ring a line.
    topology = yield from read_topology((yield from count_slaves()))
    end = find_ring_end([node for _, node in topology])
    if not ring.is_whole or end is None:
        yield from _synchronize_line(bus, present, only)
        return
    last, port = topology[end[0]][0], end[1]
    ring.is_opened = True
    failure: EapError | None = None
    try:
        closed = bytes((_ALWAYS_CLOSED << 2 * port,))
        yield from write(last, LOOP_CONTROL, closed, "loop control")
        yield from _synchronize_line(bus, present, only)
    except EapError as exc:
        failure = exc
    except GeneratorExit:
        ring.is_opened = False  # cancelled, so that the next start joins the ring
        raise
    yield from write(last, LOOP_CONTROL, b"\0", "loop control")
    yield from count_slaves()
    _, now_ns = yield Sleep(0)
    ring.end_opening(now_ns)
    if failure is not None:
        raise failure


def _synchronize_line(
    bus: BusState, present: Sequence[FoundSlave], only: frozenset[int] | None
) -> Procedure[None]:
    """Set the clocks of an opened ring by its present topology."""
    known = {each.station: each for each in present}
    topology = yield from read_topology((yield from count_slaves()))
    line = [
        known[station]._replace(position=position, node=node)
        for position, (station, node) in enumerate(topology)
        if station in known
    ]
    is_cut = bus.ring is not None and not bus.ring.is_opened
    yield from _synchronize(bus, line, only, bus.ring.reached if is_cut and bus.ring else None)


def _synchronize(
    bus: BusState,
    slaves: Sequence[FoundSlave],
    only: frozenset[int] | None,
    measured: int | None = None,
) -> Procedure[None]:
    _, now_ns = yield Sleep(0)
    time_ns = now_ns + bus.settings.epoch_offset_ns
    states = yield from synchronize(slaves, time_ns, only=only, measured=measured)
    bus.distribute_time(states[0].station if states else None)


def _prepare(bus: BusState, slave: BusSlave, current: AlState, step: AlState) -> Procedure[None]:
    """Write the registers that the slave checks on its way to *step*."""
    if current in WITH_PROCESS_DATA and step not in WITH_PROCESS_DATA:
        # Before the request: cycles with and without this slave are valid until it has left.
        bus.set_participation(slave, Participation.UNCERTAIN)
    transition = transition_of(current, step)
    if current is AlState.INIT:
        yield from _prepare_mailbox(bus, slave, step)
    elif transition is Transition.PS:
        yield from _prepare_process_data(bus, slave)
    elif transition is not None and slave.mailbox is not None:
        yield from run_writes(bus, slave, transition)


def _prepare_mailbox(bus: BusState, slave: BusSlave, step: AlState) -> Procedure[None]:
    bus.close_mailbox(slave)
    esc, fixed = slave.found.esc, slave.found.sii.fixed
    # Another master may have left FMMUs and sync managers that overlap ours.
    yield from clear(slave.station, fmmus=esc.fmmus, sync_managers=esc.sync_managers)
    area = boot_mailbox(fixed) if step is AlState.BOOT else standard_mailbox(fixed)
    if area.is_there:
        area.check(slave.station)
        yield from configure(slave.station, area)
    elif step is AlState.BOOT:
        raise BusError(f"slave {slave.station}: its EEPROM names no mailbox for BOOT")


def _end_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Remove the slave from the cycle."""
    # Without FMMUs: a controller answers logical datagrams in any AL state.
    yield from clear(slave.station, fmmus=slave.found.esc.fmmus, sync_managers=0)
    bus.set_participation(slave, Participation.ABSENT)


def _begin_preop(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Open the mailbox and send the start-up writes of IP."""
    area = standard_mailbox(slave.found.sii.fixed)
    if area.is_there:
        bus.open_mailbox(slave, area)
    # In PREOP, because INIT has no mailbox.
    yield from run_writes(bus, slave, Transition.IP)


def _prepare_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    yield from prepare_safeop(bus, slave)
    image = bus.image
    if image is None or slave.station not in image.layout.slaves:
        return
    layout = image.replan_slave(
        slave.process_data,
        is_described=slave.expected is not None and bool(slave.expected.channels),
    )
    yield from prepare_registers(bus, slave)
    # Between the write of the first FMMU and SAFEOP the slave counts partly or fully.
    bus.set_participation(slave, Participation.UNCERTAIN)
    yield from set_process_data(layout)
