"""What the high-nibble dialect asks for, done with our own conversations.

Its requests name a whole task where the standard has a message, so that nothing is passed on: the
gateway itself talks to the slave, and answers with the result or with the dialect's error.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

from devicebus.errors import (
    FoeError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
    SoeError,
)
from devicebus.mailbox import coe_client, foe_client, soe_client, voe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.bus_request import SlaveReport
from eap.codec.soe import Idn
from eap.codec.voe import VoeHeader
from eap.errors import EapError
from eap.gateway.dialect import (
    Failure,
    ReadFile,
    ReadIdn,
    ReadSdo,
    Task,
    WriteIdn,
    WriteSdo,
)
from eap.gateway.error_table import cause_of
from eap.gateway.refusal import Reason
from eap.od.abort import SdoAbortError

Converse: TypeAlias = Callable[[Conversation[Any]], Awaitable[Any]]
"""Leads a conversation with the slave."""


class DialectError(EapError):
    """A task was not done; *code* is the slave's own where the protocol has one.

    For statistics *reason* says why.
    """

    def __init__(
        self,
        failure: Failure,
        text: str,
        code: int | None = None,
        reason: Reason = Reason.SERVICE,
    ) -> None:
        super().__init__(text)
        self.failure = failure
        self.code = code
        self.reason = reason


async def perform(
    task: Task, slave: SlaveReport, converse: Converse, room: int, answer_s: float
) -> bytes:
    """Do a task with a slave; return what was read.

    Args:
        task: What is to be done.
        slave: As the engine knows it.
        converse: Leads conversations with it.
        room: Octets that can be read at most.
        answer_s: How long it may take.

    Raises:
        DialectError: it was not done.
        BusError, EngineGoneError: the slave cannot be reached.
    """
    sizes = MailboxSizes(slave.to_slave, slave.to_master)
    content = bytearray()
    try:
        async with asyncio.timeout(answer_s):
            result = await converse(_conversation(task, sizes, content, room))
    except TimeoutError:
        raise DialectError(Failure.NO_RESPONSE, "no answer in time") from None
    except SdoAbortError as exc:
        raise DialectError(Failure.GENERAL, str(exc), exc.code) from None
    except (SoeError, FoeError, MailboxTimeoutError, MailboxSizeError) as exc:
        raise DialectError(cause_of(exc).dialect, str(exc)) from None
    except MailboxRefusedError as exc:  # the dialect has no mailbox errors
        raise DialectError(Failure.NOT_SUPPORTED, str(exc)) from None
    data = bytes(content) if isinstance(task, ReadFile) else result
    if not isinstance(data, bytes):
        return b""
    if len(data) > room:
        raise too_long(room)
    return data


def too_long(room: int) -> DialectError:
    """Return the error for what is longer than a packet of *room* octets."""
    text = f"more than {room} octets do not fit one packet of this dialect"
    return DialectError(Failure.GENERAL, text)


def _conversation(
    task: Task, sizes: MailboxSizes, content: bytearray, room: int
) -> Conversation[Any]:
    match task:
        case ReadSdo(index, subindex, complete):
            return coe_client.upload(index, subindex, complete=complete)
        case WriteSdo(index, subindex, data):
            return coe_client.download(index, subindex, data, sizes)
        case ReadIdn(idn, drive, element):
            return soe_client.read(Idn.of(idn), element, drive=drive)
        case WriteIdn(idn, drive, element, data):
            return soe_client.write(Idn.of(idn), data, sizes, elements=element, drive=drive)
        case ReadFile(name):
            if not name:
                raise DialectError(Failure.FILE_NAME, "no file name")
            return foe_client.read(name, _sink(content, room), sizes)
    head = VoeHeader.decode(task.body)
    data = task.body[VoeHeader.SIZE :]
    return _with_head(task.body, voe_client.exchange(head.vendor_id, head.vendor_type, data))


def _with_head(request: bytes, talk: Conversation[bytes]) -> Conversation[bytes]:
    reply = yield from talk
    return request[: VoeHeader.SIZE] + reply


def _sink(content: bytearray, room: int) -> Callable[[bytes], None]:
    def take(data: bytes) -> None:
        content.extend(data)
        if len(content) > room:
            raise too_long(room)

    return take
