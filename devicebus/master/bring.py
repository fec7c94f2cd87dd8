"""Bringing a slave from state to state, with what has to be set up before each (ETG.1000.6)."""

from __future__ import annotations

from typing import TypeVar

from devicebus.errors import BusError, SiiError
from devicebus.mailbox.conversation import Conversation
from devicebus.master.bus import Bus, Unit
from devicebus.master.clocks import start_sync0, synchronize
from devicebus.master.configure import (
    boot_mailbox,
    clear,
    set_process_data,
    set_watchdog,
    standard_mailbox,
)
from devicebus.master.cycle import Presence
from devicebus.master.esm import acknowledge, change_state, path
from devicebus.master.mailboxes import Mailbox
from devicebus.master.mailboxport import configure
from devicebus.master.pdo import channels_from_sii, read_channels, write_choice
from devicebus.master.procedure import Procedure, Sleep
from devicebus.master.task import Task
from devicebus.wire.alstatus import AlState
from devicebus.wire.sii import SiiProtocol

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
