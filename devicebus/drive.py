"""Drivers of conversations and procedures, blocking and asynchronous.

A conversation (:mod:`devicebus.mailbox.conversation`) or procedure
(:mod:`devicebus.master.procedure`) yields requests; *exchange* carries out one request and returns
its reply.  BusError raised by *exchange* is thrown into the generator, which may handle it: a SoE
procedure command is cleared after a failure, a scan skips a slave that does not answer.  Any other
error, as of a lost engine or a cancelled task, closes the generator and goes to the caller.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator
from typing import TypeVar

from devicebus.errors import BusError

RequestT = TypeVar("RequestT")
ReplyT = TypeVar("ReplyT")
T = TypeVar("T")


def drive(
    conversation: Generator[RequestT, ReplyT, T], exchange: Callable[[RequestT], ReplyT]
) -> T:
    """Run a conversation to its end, one exchange after the other; return its result."""
    try:
        request = next(conversation)
        while True:
            try:
                reply = exchange(request)
            except BusError as exc:
                request = conversation.throw(exc)
            else:
                request = conversation.send(reply)
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        # Also after an error of *exchange*, so that a transfer under way is released at once.
        conversation.close()


async def drive_async(
    conversation: Generator[RequestT, ReplyT, T], exchange: Callable[[RequestT], Awaitable[ReplyT]]
) -> T:
    """Run a conversation to its end as :func:`drive` does, waiting for each exchange."""
    try:
        request = next(conversation)
        while True:
            try:
                reply = await exchange(request)
            except BusError as exc:
                request = conversation.throw(exc)
            else:
                request = conversation.send(reply)
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        conversation.close()
