"""Requests of the high-nibble dialect: who may have them done, and where."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

from devicebus.errors import BusError
from eap.aoe.ads_operation import Operation, ReadWrite
from eap.aoe.way import Way
from eap.appliance.services.gateway.dialect_elsewhere import perform_elsewhere
from eap.appliance.services.gateway.dialect_task import DialectError, perform
from eap.appliance.services.gateway.guard import Guard, Target, reason_of_refusal
from eap.appliance.services.gateway.master_session import MasterSession
from eap.appliance.services.gateway.remote_link import LinkTo
from eap.appliance.services.gateway.slave_book import SlaveBook
from eap.appliance.services.gateway.slave_session import find_refusal
from eap.appliance.services.slaves.bus_mailboxes import BusMailboxes
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeHeader
from eap.codec.mailbox import MailboxType
from eap.codec.sdo import SdoHeader
from eap.errors import EngineGoneError, MalformedError
from eap.gateway.address import Master, RemoteSlave, Slave
from eap.gateway.dialect import (
    Failure,
    ReadFile,
    ReadIdn,
    ReadSdo,
    Task,
    WriteIdn,
    WriteSdo,
    decode,
    encode_done,
    encode_failure,
)
from eap.gateway.error_table import cause_of
from eap.gateway.refusal import Reason
from eap.gateway.rights import idn, sdo

Whom: TypeAlias = Master | Slave | RemoteSlave

_LONGEST_HEAD = CoeHeader.SIZE + SdoHeader.SIZE
"""Octets in front of what was read, in any protocol."""


class DialectDesk:
    """Answers requests of the dialect.

    Args:
        bus: The slaves.
        book: What is known of them.
        guard: Says whether a client may have something done.
        open_master: Begins a session with the master's dictionary.
        link_to: Returns the way to a slave of another station.
        room: Octets of the longest answer.
        answer_s: How long an answer may take.
    """

    def __init__(
        self,
        bus: BusMailboxes,
        book: SlaveBook,
        guard: Guard,
        open_master: Callable[[], MasterSession],
        link_to: LinkTo,
        room: int,
        answer_s: float,
    ) -> None:
        self._bus = bus
        self._book = book
        self._guard = guard
        self._open_master = open_master
        self._link_to = link_to
        self._room = room - _LONGEST_HEAD
        self._answer_s = answer_s

    async def answer(
        self, kind: MailboxType, whom: Whom, target: Target, body: bytes, way: Way
    ) -> tuple[bytes, Reason | None]:
        """Return what answers a request, and why it is an error if it is one.

        Args:
            kind: The protocol.
            whom: Who is to do it.
            target: By what rules name him.
            body: What stands behind the mailbox header.
            way: Connection, or address, of the client.
        """
        code: int | None = None
        try:
            task = decode(kind, body)
            return await self._judge(kind, task, whom, target, body, way), None
        except MalformedError as exc:
            failure, reason, text = Failure.COMMAND, Reason.SERVICE, str(exc)
        except DialectError as exc:
            failure, reason, text, code = exc.failure, exc.reason, str(exc), exc.code
        except (BusError, EngineGoneError) as exc:
            reason, text = cause_of(exc), str(exc)
            failure = reason.dialect
        return encode_failure(kind, body, failure, code=code, text=text), reason

    async def _judge(
        self, kind: MailboxType, task: Task, whom: Whom, target: Target, body: bytes, way: Way
    ) -> bytes:
        operation = operation_of(task)
        verdict = self._guard.judge(way, target, operation)
        result: int | None = AdsError.GENERAL
        try:
            if not verdict.is_allowed:
                raise _refusal(reason_of_refusal(verdict))
            data = await self._perform(kind, task, whom, way)
            result = 0
        finally:
            self._guard.tell(way, target, operation, verdict, result)
        return encode_done(body, task, data)

    async def _perform(self, kind: MailboxType, task: Task, whom: Whom, way: Way) -> bytes:
        if isinstance(whom, Master):
            return await self._open_master().perform(task)
        if isinstance(whom, RemoteSlave):
            return await perform_elsewhere(task, self._link_to(whom), self._room)
        slave = await self._book.find(whom.station)
        reason = slave if isinstance(slave, Reason) else find_refusal(kind, b"", slave)
        if isinstance(slave, Reason) or reason is not None:
            raise _refusal(reason or Reason.NO_SLAVE)
        converse = partial(self._bus.converse, whom.station, requester=way)
        return await perform(task, slave, converse, self._room, self._answer_s)


def _refusal(reason: Reason) -> DialectError:
    return DialectError(reason.dialect, reason.text, reason=reason)


def operation_of(task: Task) -> Operation:
    """Return what a task does, in the terms of access rules."""
    match task:
        case ReadSdo(index, subindex, complete):
            return sdo(index, subindex, complete=complete)
        case WriteSdo(index, subindex, data):
            return sdo(index, subindex, complete=False, data=data)
        case ReadIdn(number, drive, _):
            return idn(number, drive)
        case WriteIdn(number, drive, _, data):
            return idn(number, drive, data)
        case ReadFile(name):
            return ReadWrite(IndexGroup.FOE_OPEN_READ, 0, 0, name.encode())
    return ReadWrite(IndexGroup.VOE, 0, 0, b"")
