"""The two mailboxes of one slave as the wire has them (ETG.1000.4, sync managers 0 and 1).

A message that was written but whose frame was lost is written again, with the counter by which the
slave knows it; one that was read but whose frame was lost is asked for again by the repeat bit.
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
"""How long a slave may take to repeat; one that never does has forgotten the message."""
POLL_NS = 200_000

FIRST_MEMORY = 0x1000
"""Where registers end and memory begins."""
_IN = Register.SYNC_MANAGER + SyncManager.SIZE
STATUS = _IN + 5
_ACTIVATE = _IN + 6
_PDI_CONTROL = _IN + 7


class MailboxArea(NamedTuple):
    """Where the mailboxes lie in a slave's memory; sizes in bytes, 0 without a mailbox."""

    to_slave: int
    to_slave_size: int
    to_master: int
    to_master_size: int

    @property
    def is_there(self) -> bool:
        """Whether the slave has a mailbox at all."""
        return min(self.to_slave_size, self.to_master_size) >= MINIMUM_SIZE

    def check(self, station: int) -> None:
        """Raise BusError if no frame can reach it, or if it lies over the registers."""
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
    """What became of a message on its way to the slave."""

    is_accepted: bool
    """False: the mailbox is still full."""
    is_ambiguous: bool
    """Whether it may have got there although it was not taken: a frame was lost."""


class MailboxPort:
    """Writes to and reads from the mailboxes of one slave.

    Attributes:
        repeats: How often the slave was asked to repeat.
    """

    def __init__(self, station: int, area: MailboxArea) -> None:
        self.station = station
        self.area = area
        self.repeats = 0
        self._repeat = 0
        self._needs_repeat = False

    def write_message(self, message: bytes) -> Procedure[WriteResult]:
        """Write a message, once its mailbox is empty.

        Raises:
            FrameLostError: nothing comes back.
        """
        padded = message.ljust(self.area.to_slave_size, b"\0")
        (reply,), _ = yield [fpwr(self.station, self.area.to_slave, padded)]
        return WriteResult(reply.wkc == 1, reply.tries > 1)

    def is_full(self) -> Procedure[bool]:
        """Return whether the slave has a message, which it repeats first if one was lost.

        Raises:
            FrameLostError: nothing comes back.
            WorkingCounterError: the slave does not answer.
        """
        if self._needs_repeat:
            yield from self._request_repeat()
        (status,) = yield from read(self.station, STATUS, 1, "mailbox status")
        return bool(status & SmStatus.MAILBOX_FULL)

    def read_message(self) -> Procedure[bytes | None]:
        """Read the slave's message, None if there is none or the frame is lost.

        The read has emptied the mailbox all the same: :meth:`is_full` has the message repeated.
        """
        area = self.area
        try:
            (reply,), _ = yield [fprd(self.station, area.to_master, area.to_master_size, tries=1)]
        except FrameLostError:
            self._needs_repeat = True
            self._repeat ^= 1
            self.repeats += 1
            return None
        return reply.data if reply.wkc else None

    def _request_repeat(self) -> Procedure[None]:
        """Hand the toggled repeat bit to the slave and wait until it has copied it."""
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
    yield from write(station, Register.SYNC_MANAGER, bytes(len(octets)), "sync managers")
    yield from write(station, Register.SYNC_MANAGER, octets, "sync managers")
