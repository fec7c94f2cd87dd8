"""Bringing a slave from state to state, with what has to be set up before each (ETG.1000.6)."""

from __future__ import annotations

from typing import TypeVar

from devicebus.errors import BusError, SiiError
from devicebus.mailbox.conversation import Conversation
from devicebus.master.bus import Bus, Unit
from devicebus.master.clocks import start_sync0, synchronize
from devicebus.master.cycle import Presence
from devicebus.master.esm import acknowledge, change_state, path
from devicebus.master.image import MAX_FMMUS, Place
from devicebus.master.mailboxes import Mailbox
from devicebus.master.mailboxport import MailboxArea, configure
from devicebus.master.pdo import channels_from_sii, read_channels, write_choice
from devicebus.master.procedure import Procedure, Sleep, Task, write
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.sii import SiiFixed, SiiProtocol

MAX_SYNC_MANAGERS = 16
WATCHDOG_DIVIDER = 2498
"""Gives steps of 100 µs."""
_STEPS_PER_MS = 10
MAX_WATCHDOG_MS = 0xFFFF // _STEPS_PER_MS


def standard_mailbox(fixed: SiiFixed) -> MailboxArea:
    """Return the mailboxes for PREOP, SAFEOP and OP."""
    return MailboxArea(fixed.receive_offset, fixed.receive_size, fixed.send_offset, fixed.send_size)


def boot_mailbox(fixed: SiiFixed) -> MailboxArea:
    """Return the mailboxes for BOOT."""
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


def set_process_data(place: Place) -> Procedure[None]:
    """Write the sync managers and FMMUs of a slave in PREOP.

    Raises WorkingCounterError if it does not answer.
    """
    for number, manager in place.sync_managers:
        at = Register.SYNC_MANAGER + SyncManager.SIZE * number
        yield from write(place.station, at, manager.encode(), f"sync manager {number}")
    if place.fmmus:
        octets = b"".join(fmmu.encode() for fmmu in place.fmmus)
        yield from write(place.station, Register.FMMU, octets, "FMMUs")


def set_watchdog(station: int, timeout_ms: int) -> Procedure[None]:
    """Set the time after which a slave without new outputs leaves OP; 0 switches it off.

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

_POLL_NS = 100_000
_WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))


def bring(bus: Bus, unit: Unit, target: AlState) -> Procedure[None]:
    """Bring a slave to *target*, step by step.

    Raises:
        AlStatusError, StateTimeoutError: it refuses, or takes too long.
        SiiError: nothing is known of it, for its EEPROM cannot be read.
        WorkingCounterError: it does not answer.
    """
    if unit.found.fault:
        raise SiiError(unit.found.fault)
    unit.state = current = yield from acknowledge(unit.station)
    if current is AlState.INIT:
        bus.close_mailbox(unit)
    for step in path(current, target):
        yield from _prepare(bus, unit, current, step)
        yield from change_state(unit.station, step)
        before, unit.state, current = current, step, step
        if step is AlState.INIT:
            bus.close_mailbox(unit)  # not before: the slave may have stayed where it has one
        if before in _WITH_PROCESS_DATA and step not in _WITH_PROCESS_DATA:
            yield from _end_process_data(bus, unit)
        unit.is_set_up = step in _WITH_PROCESS_DATA
        if step in _WITH_PROCESS_DATA:
            bus.set_presence(unit, Presence.PRESENT)
        elif step is AlState.BOOT:
            bus.open_mailbox(unit, boot_mailbox(unit.found.sii.fixed))
        elif step is AlState.PREOP and unit.mailbox is None:
            yield from _begin_preop(bus, unit)
    unit.state = target


def read_process_data(bus: Bus, unit: Unit) -> Procedure[None]:
    """Find out what a slave in PREOP exchanges."""
    sii = unit.found.sii
    if unit.mailbox is not None and sii.fixed.protocols & SiiProtocol.COE:
        reading = read_channels(sii)
        unit.channels = yield from _ask(bus, unit.mailbox, reading, "reading PDOs")
    else:
        unit.channels = channels_from_sii(sii)


def set_clocks(bus: Bus, *, only: frozenset[int] | None = None) -> Procedure[None]:
    """Set the clocks of all slaves, or *only* of those that came back."""
    _, now_ns = yield Sleep(0)
    present = [unit.found for unit in bus.units.values() if not unit.is_lost]
    states = yield from synchronize(present, now_ns + bus.settings.epoch_offset_ns, only=only)
    bus.follow(states[0].station if states else None)


def wait_for(task: Task[T]) -> Procedure[T]:
    """Wait within a procedure for something that runs beside it; return its result."""
    while not task.is_done:
        yield Sleep(_POLL_NS)
    return task.result()


def _prepare(bus: Bus, unit: Unit, current: AlState, step: AlState) -> Procedure[None]:
    """Set up what the slave checks on its way to *step*."""
    if current in _WITH_PROCESS_DATA and step not in _WITH_PROCESS_DATA:
        bus.set_presence(unit, Presence.UNSURE)
    if current is AlState.INIT:
        yield from _prepare_mailbox(bus, unit, step)
    elif current is AlState.PREOP and step is AlState.SAFEOP:
        yield from _prepare_process_data(bus, unit)


def _prepare_mailbox(bus: Bus, unit: Unit, step: AlState) -> Procedure[None]:
    bus.close_mailbox(unit)
    esc, fixed = unit.found.esc, unit.found.sii.fixed
    yield from clear(unit.station, fmmus=esc.fmmus, sync_managers=esc.sync_managers)
    area = boot_mailbox(fixed) if step is AlState.BOOT else standard_mailbox(fixed)
    if area.is_there:
        area.check(unit.station)
        yield from configure(unit.station, area)
    elif step is AlState.BOOT:
        raise BusError(f"slave {unit.station}: its EEPROM names no mailbox for BOOT")


def _end_process_data(bus: Bus, unit: Unit) -> Procedure[None]:
    """Take the slave out of the cycle: a controller would go on counting in any state."""
    yield from clear(unit.station, fmmus=unit.found.esc.fmmus, sync_managers=0)
    bus.set_presence(unit, Presence.AWAY)


def _begin_preop(bus: Bus, unit: Unit) -> Procedure[None]:
    """Open the mailbox and tell the slave what to exchange."""
    area = standard_mailbox(unit.found.sii.fixed)
    if not area.is_there:
        return
    bus.open_mailbox(unit, area)
    choice = bus.settings.choices.get(unit.station)
    mailbox = unit.mailbox
    if choice is not None and mailbox is not None:
        yield from _ask(bus, mailbox, write_choice(choice, mailbox.sizes), "setting PDOs")


def _ask(bus: Bus, mailbox: Mailbox, conversation: Conversation[T], name: str) -> Procedure[T]:
    _, now_ns = yield Sleep(0)
    task = mailbox.converse(conversation, now_ns, name=name, requester=bus)
    return (yield from wait_for(task))


def _prepare_process_data(bus: Bus, unit: Unit) -> Procedure[None]:
    place = bus.image.layout.places.get(unit.station) if bus.image is not None else None
    if place is None:
        return
    if bus.settings.watchdog_ms is not None:
        yield from set_watchdog(unit.station, bus.settings.watchdog_ms)
    sync0 = bus.settings.sync0.get(unit.station)
    if sync0 is not None and bus.reference is not None:
        yield from start_sync0(unit.station, sync0)
    bus.set_presence(unit, Presence.UNSURE)
    yield from set_process_data(place)
