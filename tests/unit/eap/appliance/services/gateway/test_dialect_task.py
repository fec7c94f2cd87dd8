"""Tasks of the dialect, and what goes wrong with them; those that succeed are in test_gateway."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from devicebus.errors import (
    FoeError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
    SoeError,
)
from devicebus.mailbox.conversation import Conversation, Message
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.gateway.dialect_task import DialectError, perform
from eap.codec.mailbox import MailboxType
from eap.gateway.dialect import Failure, ReadFile, ReadSdo, Task
from eap.od.abort import SdoAbortError

SLAVE = SlaveReport(
    station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0, state=8, target=8,
    to_slave=64, to_master=64, protocols=0x3F,
)  # fmt: skip
UPLOAD = ReadSdo(0x1018, 1, complete=False)


def failing(error: Exception | None) -> Any:
    async def converse(conversation: Conversation[Any]) -> Any:
        conversation.close()
        if error is None:
            await asyncio.sleep(1)
        raise error or AssertionError

    return converse


@pytest.mark.parametrize(
    ("error", "failure", "code"),
    [
        (SdoAbortError(0x06090011, 0x1018, 9), Failure.GENERAL, 0x06090011),
        (SoeError("x", code=0x1001), Failure.MISSING, None),
        (SoeError("x", code=0x7004), Failure.READ_ONLY, None),
        (SoeError("x", code=0x9999), Failure.GENERAL, None),
        (FoeError("x", code=0x8001), Failure.MISSING, None),
        (FoeError("x", code=0x8003), Failure.GENERAL, None),
        (MailboxTimeoutError("x"), Failure.NO_RESPONSE, None),
        (MailboxSizeError("x"), Failure.SIZE, None),
        (MailboxRefusedError("x", detail=2), Failure.NOT_SUPPORTED, None),
        (None, Failure.NO_RESPONSE, None),
    ],
)
def test_failures(error, failure, code) -> None:
    with pytest.raises(DialectError) as caught:
        asyncio.run(perform(UPLOAD, SLAVE, failing(error), 100, 0.01))
    assert (caught.value.failure, caught.value.code) == (failure, code)


def reading(*packets: bytes) -> Any:
    async def converse(conversation: Conversation[Any]) -> Any:
        next(conversation)
        try:
            for packet in packets:
                conversation.send(Message(MailboxType.FOE, packet))
        except StopIteration as end:
            return end.value
        raise AssertionError("it wants more")

    return converse


def read(task: Task, *packets: bytes) -> bytes:
    return asyncio.run(perform(task, SLAVE, reading(*packets), 80, 1.0))


def test_files() -> None:
    first = bytes.fromhex("03 00 01000000") + b"a" * 52
    last = bytes.fromhex("03 00 02000000") + b"b" * 20
    assert read(ReadFile("f"), first, last, b"") == b"a" * 52 + b"b" * 20
    with pytest.raises(DialectError, match="more than 80 octets do not fit one packet"):
        read(ReadFile("f"), first, bytes.fromhex("03 00 02000000") + b"b" * 52)
    with pytest.raises(DialectError, match="no file name") as caught:
        read(ReadFile(""))
    assert caught.value.failure is Failure.FILE_NAME


def test_what_is_read_has_to_fit_one_packet() -> None:
    def read(octets: bytes) -> bytes:
        async def converse(conversation: Conversation[Any]) -> Any:
            conversation.close()
            return octets

        return asyncio.run(perform(UPLOAD, SLAVE, converse, 80, 1.0))

    assert read(bytes(80)) == bytes(80)
    with pytest.raises(DialectError, match="more than 80 octets do not fit one packet"):
        read(bytes(81))
