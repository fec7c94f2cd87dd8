"""State changes of a slave, with the registers that each state needs (ETG.1000.6)."""

from __future__ import annotations

from typing import TypeVar

from devicebus.errors import BusError, SiiError
from devicebus.mailbox.conversation import Conversation
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.clocks import start_sync0, synchronize
from devicebus.master.cycle import Participation
from devicebus.master.esm import acknowledge, change_state, path
from devicebus.master.image import MAX_FMMUS, SlaveLayout
from devicebus.master.mailboxes import Mailbox, MailboxArea, configure
from devicebus.master.pdo import channels_from_sii, read_channels, write_configuration
from devicebus.master.procedure import Procedure, Sleep, Task, write
from devicebus.wire.alstatus import WITH_PROCESS_DATA, AlState
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.sii import SiiFixed, SiiProtocol

MAX_SYNC_MANAGERS = 16
# The register counts (n + 2) periods of 40 ns.
WATCHDOG_DIVIDER = 2498
"""Watchdog divider for steps of 100 µs."""
_STEPS_PER_MS = 10
MAX_WATCHDOG_MS = 0xFFFF // _STEPS_PER_MS


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


def set_watchdog(station: int, timeout_ms: int) -> Procedure[None]:
    """Set the process data watchdog: without outputs for so long a slave leaves OP; 0 disables it.

    Raises:
        ValueError: the time does not fit the register.
        WorkingCounterError: the slave does not answer.
    """
    if not 0 <= timeout_ms <= MAX_WATCHDOG_MS:
        raise ValueError(f"watchdog of {timeout_ms} ms, expected 0 to {MAX_WATCHDOG_MS}")
    divider = WATCHDOG_DIVIDER.to_bytes(2, "little")
    steps = (timeout_ms * _STEPS_PER_MS).to_bytes(2, "little")
    yield from write(station, Register.WATCHDOG_DIVIDER, divider, "watchdog divider")
    yield from write(station, Register.WATCHDOG_PROCESS_DATA, steps, "watchdog")


T = TypeVar("T")

# A message of a conversation takes about a cycle.  Checks every 100 µs resumed the procedures of
# 200 slaves 770,000 times during one start-up.
_FIRST_PAUSE_NS = 100_000
# Pause between two checks of a task; it doubles from the first to this.
_MAX_PAUSE_NS = 2_000_000


def bring(bus: BusState, slave: BusSlave, target: AlState) -> Procedure[None]:
    """Bring a slave to *target*, step by step.

    Raises:
        AlStatusError, StateTimeoutError: the slave refuses, or takes too long.
        SiiError: its EEPROM cannot be read, so its configuration is unknown.
        WorkingCounterError: the slave does not answer.
    """
    if slave.found.fault:
        raise SiiError(slave.found.fault)
    slave.state = current = yield from acknowledge(slave.station)
    if current is AlState.INIT:
        bus.close_mailbox(slave)
    for step in path(current, target):
        yield from _prepare(bus, slave, current, step)
        yield from change_state(slave.station, step)
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


def read_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Read the PDO mapping of a slave in PREOP."""
    sii = slave.found.sii
    if slave.mailbox is not None and sii.fixed.protocols & SiiProtocol.COE:
        reading = read_channels(sii)
        slave.channels = yield from _ask(bus, slave.mailbox, reading, "reading PDOs")
    else:
        slave.channels = channels_from_sii(sii)


def set_clocks(bus: BusState, *, only: frozenset[int] | None = None) -> Procedure[None]:
    """Set the clocks of all slaves, or *only* of the given stations."""
    _, now_ns = yield Sleep(0)
    present = [slave.found for slave in bus.slaves.values() if not slave.is_lost]
    states = yield from synchronize(present, now_ns + bus.settings.epoch_offset_ns, only=only)
    bus.distribute_time(states[0].station if states else None)


def wait_for(task: Task[T]) -> Procedure[T]:
    """Wait within a procedure for another task; return its result."""
    pause_ns = _FIRST_PAUSE_NS
    while not task.is_done:
        yield Sleep(pause_ns)
        pause_ns = min(2 * pause_ns, _MAX_PAUSE_NS)
    return task.result()


def _prepare(bus: BusState, slave: BusSlave, current: AlState, step: AlState) -> Procedure[None]:
    """Write the registers that the slave checks on its way to *step*."""
    if current in WITH_PROCESS_DATA and step not in WITH_PROCESS_DATA:
        # Before the request: cycles with and without this slave are valid until it has left.
        bus.set_participation(slave, Participation.UNCERTAIN)
    if current is AlState.INIT:
        yield from _prepare_mailbox(bus, slave, step)
    elif current is AlState.PREOP and step is AlState.SAFEOP:
        yield from _prepare_process_data(bus, slave)


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
    """Open the mailbox and write the PDO configuration."""
    area = standard_mailbox(slave.found.sii.fixed)
    if not area.is_there:
        return
    bus.open_mailbox(slave, area)
    configuration = bus.settings.pdo_configurations.get(slave.station)
    mailbox = slave.mailbox
    if configuration is not None and mailbox is not None:
        yield from _ask(
            bus, mailbox, write_configuration(configuration, mailbox.sizes), "setting PDOs"
        )


def _ask(bus: BusState, mailbox: Mailbox, conversation: Conversation[T], name: str) -> Procedure[T]:
    _, now_ns = yield Sleep(0)
    task = mailbox.converse(conversation, now_ns, name=name, requester=bus)
    return (yield from wait_for(task))


def _prepare_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    layout = bus.image.layout.slaves.get(slave.station) if bus.image is not None else None
    if layout is None:
        return
    if bus.settings.watchdog_ms is not None:
        yield from set_watchdog(slave.station, bus.settings.watchdog_ms)
    sync0 = bus.settings.sync0.get(slave.station)
    if sync0 is not None and bus.reference is not None:
        yield from start_sync0(slave.station, sync0)
    # Between the write of the first FMMU and SAFEOP the slave counts partly or fully.
    bus.set_participation(slave, Participation.UNCERTAIN)
    yield from set_process_data(layout)
