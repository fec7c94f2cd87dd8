"""Frames of type 5: what is taken, and how answers are packed."""

from __future__ import annotations

import asyncio
from time import monotonic_ns

import pytest

from eap.appliance.discards import Refusal
from eap.appliance.services.mailbox_door import MailboxDoor
from tests.support import aoe

TARGET = "1.1.1.1.2.1"


def tell(*frames: bytes, largest: int = 1472, for_all: bool = False):
    """Return what the door made of each frame, and what came back."""
    desk = aoe.echoing_desk(TARGET)
    door = MailboxDoor([desk], largest)
    sent: list[bytes] = []

    async def script():
        reasons = [
            door.receive_frame(each, sent.append, monotonic_ns(), for_all=for_all)
            for each in frames
        ]
        await desk.wait_idle()
        return reasons

    async def run():
        serving = asyncio.ensure_future(desk.serve())
        try:
            return await script()
        finally:
            serving.cancel()

    return asyncio.run(run()), sent


def ask(body: bytes = b"abc", **more) -> bytes:
    return aoe.frame(aoe.packet(TARGET, 4, body), **more)


def test_aoe_to_address_0_is_answered():
    reasons, sent = tell(ask(), ask(counter=1), ask(counter=0))
    assert reasons == [None] * 3
    assert [aoe.answer(each).data for each in sent] == [b"\4cba"] * 3
    assert [each[7] >> 4 for each in sent] == [1, 2, 3]  # our own counter


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (ask(address=1001), Refusal.MAILBOX),
        (ask(kind=3), Refusal.MAILBOX),
        (ask(kind=9), Refusal.TRUNCATED),
        (ask()[:-1], Refusal.TRUNCATED),
        (aoe.frame(b"too short"), Refusal.MAILBOX),
        (b"\x00\x50", Refusal.TRUNCATED),
    ],
)
def test_others_are_not_taken(frame, reason):
    assert tell(frame) == ([reason], [])


def test_stranger_is_told_unless_many_were_asked():
    frame = aoe.frame(aoe.packet("9.9.9.9.9.9", 4, b""))
    _, sent = tell(frame)
    assert aoe.answer(sent[0]).error == 7
    assert tell(frame, for_all=True) == ([None], [])


def test_answers_fit_the_transport():
    _, sent = tell(ask(b"x" * 200), largest=100)
    assert len(sent) > 1
    assert all(len(each) <= 100 for each in sent)
