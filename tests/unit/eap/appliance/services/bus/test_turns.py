"""Turns are taken round robin."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from eap.appliance.services.bus.turns import Turns


def test_requesters_alternate_whoever_asks_more():
    order = []

    async def use(turns, requester):
        await turns.take("x", requester)
        order.append(requester)
        await asyncio.sleep(0)
        turns.give_back("x")

    async def play():
        turns = Turns()
        async with asyncio.TaskGroup() as group:
            for requester in "aaaabb":
                group.create_task(use(turns, requester))

    asyncio.run(play())
    assert "".join(order) == "aababa"


def test_other_things_are_free():
    async def play():
        turns = Turns()
        await turns.take("x", 1)
        await asyncio.wait_for(turns.take("y", 1), 1)
        turns.give_back("x")
        await asyncio.wait_for(turns.take("x", 2), 1)

    asyncio.run(play())


def test_who_leaves_loses_nothing_for_others():
    async def play():
        turns = Turns()
        await turns.take("x", 1)
        leaving = asyncio.ensure_future(turns.take("x", 2))
        staying = asyncio.ensure_future(turns.take("x", 3))
        await asyncio.sleep(0)
        leaving.cancel()
        turns.give_back("x")
        await asyncio.wait_for(staying, 1)
        late = asyncio.ensure_future(turns.take("x", 4))
        last = asyncio.ensure_future(turns.take("x", 5))
        await asyncio.sleep(0)
        turns.give_back("x")
        late.cancel()  # it has its turn already, and does not take it
        await asyncio.wait_for(last, 1)
        for task in (leaving, late):
            with suppress(asyncio.CancelledError):
                await task

    asyncio.run(play())
