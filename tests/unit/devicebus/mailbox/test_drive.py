from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator

import pytest

from devicebus.errors import BusError, MailboxTimeoutError
from devicebus.mailbox.conversation import drive, drive_async
from eap.errors import EngineGoneError
from tests.support.virtualtime import run_virtual


class Scripted:
    """Conversation of two requests; *log* has what happened to it."""

    def __init__(self) -> None:
        self.log: list[str] = []

    def conversation(self) -> Generator[int, str, str]:
        try:
            try:
                first = yield 1
            except MailboxTimeoutError as exc:
                first = f"<{exc}>"
            second = yield 2
            return first + second
        finally:
            self.log.append("closed")


def blocking(conversation: Generator[int, str, str], exchange: Callable[[int], str]) -> str:
    return drive(conversation, exchange)


def asynchronous(conversation: Generator[int, str, str], exchange: Callable[[int], str]) -> str:
    async def exchange_later(request: int) -> str:
        await asyncio.sleep(0)
        return exchange(request)

    return run_virtual(drive_async(conversation, exchange_later))


each_way = pytest.mark.parametrize("run", [blocking, asynchronous])


@each_way
def test_drive_returns_the_result_of_the_conversation(run):
    assert run(Scripted().conversation(), lambda request: f"reply {request};") == "reply 1;reply 2;"


@each_way
def test_drive_throws_bus_errors_into_the_conversation(run):
    def exchange(request: int) -> str:
        if request == 1:
            raise MailboxTimeoutError("no reply")
        return "end"

    assert run(Scripted().conversation(), exchange) == "<no reply>end"


@each_way
def test_drive_raises_bus_errors_that_the_conversation_does_not_handle(run):
    def exchange(request: int) -> str:
        if request == 2:
            raise BusError("gone")
        return ""

    script = Scripted()
    with pytest.raises(BusError, match="gone"):
        run(script.conversation(), exchange)
    assert script.log == ["closed"]


@each_way
def test_drive_closes_the_conversation_on_other_errors(run):
    def exchange(request: int) -> str:
        raise EngineGoneError("restarted")

    script = Scripted()
    with pytest.raises(EngineGoneError):
        run(script.conversation(), exchange)
    assert script.log == ["closed"]


def test_drive_async_closes_a_conversation_whose_task_is_cancelled():
    script = Scripted()

    async def scene() -> None:
        never = asyncio.get_running_loop().create_future()
        task = asyncio.ensure_future(drive_async(script.conversation(), lambda _: never))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(scene())
    assert script.log == ["closed"]


@each_way
def test_drive_returns_at_once_when_nothing_is_requested(run):
    def conversation() -> Generator[int, str, str]:
        return "empty"
        yield 0

    assert run(conversation(), lambda request: "") == "empty"
