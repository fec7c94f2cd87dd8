"""Requests of the high-nibble dialect: each names a whole operation on a slave or the master.

What the dialect knows of errors is coarser than any protocol: a slave's own code goes back only in
an SDO abort.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from devicebus.errors import FoeError, MailboxRefusedError, SoeError
from eap.ads.request import Operation, ReadWrite
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeHeader, SdoHeader
from eap.codec.mailbox import MailboxType
from eap.errors import EapError, MalformedError
from eap.gateway.dialect import (
    DialectFailure,
    ExchangeVoe,
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
from eap.gateway.error_table import Cause, cause_of_result
from eap.gateway.requests import GatewayError, idn, sdo
from eap.ids import Endpoint
from eap.od.abort import SdoAbortError
from eap.services.gateway.admission import GatewayAdmission, RuleTarget, denial_cause
from eap.services.gateway.sessions import MasterSession, cause_of, text_of
from eap.services.slaves.access import RemoteAccessError, SlaveAccess

DialectTarget: TypeAlias = SlaveAccess | MasterSession
FindTarget: TypeAlias = Callable[[], Awaitable[DialectTarget]]
"""Returns a slave or the master; raises GatewayError if it cannot be reached."""

_LONGEST_HEAD = CoeHeader.SIZE + SdoHeader.SIZE
"""Octets in front of what was read, in any protocol."""


class DialectError(EapError):
    """A request of the dialect that was not carried out.

    Attributes:
        failure: Kind of the error, which each protocol has a code for.
        code: The slave's own code, for protocols that have one.
        cause: For statistics.
    """

    def __init__(
        self,
        failure: DialectFailure,
        text: str,
        code: int | None = None,
        cause: Cause = Cause.SERVICE,
    ) -> None:
        super().__init__(text)
        self.failure = failure
        self.code = code
        self.cause = cause


class DialectHandler:
    """Carries out requests of the dialect.

    Args:
        admission: Access rules and audit.
        max_size: Bytes of the longest answer.
        answer_s: Limit for an answer.
    """

    def __init__(self, admission: GatewayAdmission, max_size: int, answer_s: float) -> None:
        self._admission = admission
        self._max_size = max_size - _LONGEST_HEAD
        self._answer_s = answer_s

    async def answer(
        self,
        kind: MailboxType,
        body: bytes,
        endpoint: Endpoint,
        target: RuleTarget,
        find: FindTarget,
    ) -> tuple[bytes, Cause | None]:
        """Return the answer to a request, and why it is an error if it is one.

        Args:
            kind: The protocol.
            body: Behind the mailbox header.
            endpoint: Connection, or address, of the client.
            target: Its name in access rules.
            find: Returns the slave or the master.
        """
        try:
            task = decode(kind, body)
            data = await self._perform_allowed(task, endpoint, target, find)
            return encode_done(body, task, data), None
        except MalformedError as exc:
            error = DialectError(DialectFailure.COMMAND, str(exc))
        except DialectError as exc:
            error = exc
        answer = encode_failure(kind, body, error.failure, code=error.code, text=str(error))
        return answer, error.cause

    async def _perform_allowed(
        self, task: Task, endpoint: Endpoint, target: RuleTarget, find: FindTarget
    ) -> bytes:
        operation = operation_of(task)
        decision = self._admission.decide(endpoint, target, operation)
        result: int | None = AdsError.GENERAL
        try:
            if not decision.is_allowed:
                raise _dialect_error(GatewayError(denial_cause(decision)))
            try:
                target_access = await find()
            except GatewayError as exc:
                raise _dialect_error(exc) from None
            data = await self._perform(task, target_access)
            result = 0
        finally:
            self._admission.record(endpoint, target, operation, decision, result)
        return data

    async def _perform(self, task: Task, subject: DialectTarget) -> bytes:
        """Carry out a task; return the data read, raise DialectError."""
        try:
            async with asyncio.timeout(self._answer_s):
                if isinstance(subject, MasterSession):
                    return await _perform_by_master(task, subject)
                data = await perform(task, subject, self._max_size)
        except TimeoutError:
            raise DialectError(
                DialectFailure.NO_RESPONSE, Cause.TIMEOUT.text, cause=Cause.TIMEOUT
            ) from None
        except DialectError:
            raise
        except EapError as exc:
            raise _dialect_error(exc) from None
        if len(data) > self._max_size:
            raise _too_long(self._max_size)
        return data


async def perform(task: Task, access: SlaveAccess, max_size: int) -> bytes:
    """Carry out a task at a slave; return the data, at most a little more than *max_size* bytes.

    Raises:
        EapError: as SlaveAccess does.
    """
    match task:
        case ReadSdo(index, subindex, complete):
            return await access.read_object(index, subindex, complete=complete)
        case WriteSdo(index, subindex, data):
            await access.write_object(index, subindex, data)
        case ReadIdn(number, drive, element):
            return await access.read_elements(number, element, drive=drive)
        case WriteIdn(number, drive, element, data):
            await access.write_elements(number, element, data, drive=drive)
        case ReadFile(name):
            return await _read_file(name, access, max_size)
        case ExchangeVoe(body):
            return await access.exchange_vendor(body)
    return b""


async def _read_file(name: str, access: SlaveAccess, max_size: int) -> bytes:
    if not name:
        raise DialectError(DialectFailure.FILE_NAME, "no file name")
    file = access.open_file(name, 0, is_write=False)
    try:
        # One byte more than fits shows that the file is too long, without reading all of it.
        return await file.read(max_size + 1)
    finally:
        file.close()


async def _perform_by_master(task: Task, master: MasterSession) -> bytes:
    match task:
        case ReadSdo(index, subindex, complete):
            return await master.read(index, subindex, complete=complete)
        case WriteSdo(index, subindex, data):
            master.write(index, subindex, data)
            return b""
    raise DialectError(DialectFailure.NOT_SUPPORTED, "the master has only a CoE dictionary")


def _dialect_error(error: EapError) -> DialectError:
    text = str(error)
    match error:
        case SdoAbortError():
            return DialectError(DialectFailure.GENERAL, text, error.code)
        case MailboxRefusedError():  # the dialect has no mailbox errors
            return DialectError(DialectFailure.NOT_SUPPORTED, text)
        case RemoteAccessError() if not error.is_routing_error:
            return DialectError(cause_of_result(error.result).dialect, text)
        case SoeError() | FoeError():
            return DialectError(cause_of(error).dialect, text)
    cause = cause_of(error)
    return DialectError(cause.dialect, text_of(error) or cause.text, cause=cause)


def _too_long(max_size: int) -> DialectError:
    text = f"more than {max_size} bytes do not fit one packet of this dialect"
    return DialectError(DialectFailure.GENERAL, text)


def operation_of(task: Task) -> Operation:
    """Return the operation of a task for access rules."""
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
