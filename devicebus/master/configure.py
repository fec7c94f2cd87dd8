"""Setting up the process data of one slave: sync managers, FMMUs, watchdog."""

from __future__ import annotations

from devicebus.master.layout import MAX_FMMUS, Place
from devicebus.master.mailboxport import MailboxArea
from devicebus.master.procedure import Procedure, write
from devicebus.wire.register import Fmmu, Register, SyncManager
from devicebus.wire.siirecord import SiiFixed

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
