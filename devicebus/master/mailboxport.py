"""Mailbox sync managers 0 and 1 of one slave, read and written by a master (ETG.1000.4).

A message whose write frame was lost is written again with the same counter, by which the slave
drops the repetition.  A message whose read frame was lost is requested again by the repeat bit.
"""

from __future__ import annotations

from typing import NamedTuple

from devicebus.errors import BusError, FrameLostError
from devicebus.mailbox.protocol import MINIMUM_SIZE
from devicebus.master.link import MAX_DATA
from devicebus.master.procedure import Procedure, Sleep, read, write
from devicebus.wire.datagram import fprd, fpwr
from devicebus.wire.register import Register, SmStatus, SyncManager

REPEAT_TIMEOUT_NS = 100_000_000
"""Time-out for the repeat acknowledge; after it the message is lost."""
POLL_NS = 200_000

FIRST_MEMORY = 0x1000
"""First address of the process data memory, behind the registers."""
_IN = Register.SYNC_MANAGER + SyncManager.SIZE
STATUS = _IN + 5
_ACTIVATE = _IN + 6
_PDI_CONTROL = _IN + 7


class MailboxArea(NamedTuple):
    """Addresses and sizes in bytes of a slave's mailboxes; size 0 without a mailbox."""

    to_slave: int
    to_slave_size: int
    to_master: int
    to_master_size: int

    @property
    def is_there(self) -> bool:
        """True if the slave has a mailbox."""
        return min(self.to_slave_size, self.to_master_size) >= MINIMUM_SIZE

    def check(self, station: int) -> None:
        """Raise BusError if an area exceeds a frame, or overlaps the registers."""
        for start, size in (self[:2], self[2:]):
            if size > MAX_DATA or not FIRST_MEMORY <= start <= 0x1_0000 - size:
                raise BusError(
                    f"slave {station}: its mailbox of {size} bytes at 0x{start:04X} cannot be,"
                    f" expected at most {MAX_DATA} bytes from 0x{FIRST_MEMORY:04X} on"
                )

    def sync_managers(self) -> tuple[SyncManager, SyncManager]:
        """Return the registers of sync managers 0 and 1."""
        return (
            SyncManager(self.to_slave, self.to_slave_size, 2, 1, pdi_interrupt=1, enable=1),
            SyncManager(self.to_master, self.to_master_size, 2, 0, pdi_interrupt=1, enable=1),
        )


class WriteResult(NamedTuple):
    """Result of writing a message."""

    is_accepted: bool
    """False: the mailbox is still full."""
    is_ambiguous: bool
    """True if a frame was lost, so that the slave may have received the message all the same."""


class MailboxPort:
    """Access to the mailboxes of one slave.

    Attributes:
        repeats: Number of repeat requests.
    """

    def __init__(self, station: int, area: MailboxArea) -> None:
        self.station = station
        self.area = area
        self.repeats = 0
        self._repeat = 0
        self._needs_repeat = False

    def write_message(self, message: bytes) -> Procedure[WriteResult]:
        """Write a message; a full mailbox refuses it.

        Raises:
            FrameLostError: no frame comes back.
        """
        # The mailbox becomes full when its last byte is written, so the whole area is sent.
        padded = message.ljust(self.area.to_slave_size, b"\0")
        (reply,), _ = yield [fpwr(self.station, self.area.to_slave, padded)]
        return WriteResult(reply.wkc == 1, reply.tries > 1)

    def is_full(self) -> Procedure[bool]:
        """Return true if the slave has a message; request a repetition first if one was lost.

        Raises:
            FrameLostError: no frame comes back.
            WorkingCounterError: the slave does not answer.
        """
        if self._needs_repeat:
            yield from self._request_repeat()
        (status,) = yield from read(self.station, STATUS, 1, "mailbox status")
        return bool(status & SmStatus.MAILBOX_FULL)

    def read_message(self) -> Procedure[bytes | None]:
        """Read the slave's message; return None without a message or if the frame is lost.

        A lost read frame has emptied the mailbox: :meth:`is_full` requests the repetition.
        """
        area = self.area
        try:
            # Sent once: a lost read has emptied the mailbox, a second read would only fail.
            (reply,), _ = yield [fprd(self.station, area.to_master, area.to_master_size, tries=1)]
        except FrameLostError:
            self._needs_repeat = True
            self._repeat ^= 1
            self.repeats += 1
            return None
        return reply.data if reply.wkc else None

    def _request_repeat(self) -> Procedure[None]:
        """Toggle the repeat bit of SM 1 (0x080E bit 1) and wait for its copy (0x080F bit 1)."""
        octet = bytes((1 | self._repeat << 1,))
        yield from write(self.station, _ACTIVATE, octet, "repeat request")
        _, now_ns = yield Sleep(0)
        deadline_ns = now_ns + REPEAT_TIMEOUT_NS
        while now_ns < deadline_ns:
            (copied,) = yield from read(self.station, _PDI_CONTROL, 1, "repeat acknowledge")
            if copied >> 1 & 1 == self._repeat:
                break
            _, now_ns = yield Sleep(POLL_NS)
        self._needs_repeat = False


def configure(station: int, area: MailboxArea) -> Procedure[None]:
    """Write sync managers 0 and 1; the slave must be in INIT.

    Raises WorkingCounterError if the slave does not answer.
    """
    octets = b"".join(each.encode() for each in area.sync_managers())
    # A sync manager is reconfigured while it is disabled.
    yield from write(station, Register.SYNC_MANAGER, bytes(len(octets)), "sync managers")
    yield from write(station, Register.SYNC_MANAGER, octets, "sync managers")
