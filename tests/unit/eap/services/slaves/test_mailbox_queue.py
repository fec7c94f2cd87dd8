"""Turns at a mailbox; whole conversations are in test_bus_client."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest
from msgspec.structs import replace

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import MailboxRequest, drive_async
from eap.codec.mailbox import MailboxType
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.engine_link import EngineLink
from eap.services.slaves.bus_client import MailboxLock, MailboxQueues
from tests.support.eventually import settle
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

VENDOR = MailboxRequest(MailboxType.COE, bytes.fromhex("00204018100100000000"))


def play(scene, kind=MailboxType.COE):
    """Run *scene* with a turn, the engine, and the list to which giving back adds."""

    async def run():
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        given = []
        try:
            await scene(MailboxLock(link, 0, 1001, kind, lambda: given.append(1)), engine, given)
        finally:
            link.close()
            engine.close()

    run_virtual(run())


def test_mailbox_turn_passes_a_step_as_requested():
    async def scene(turn, engine, given):
        message = await turn.exchange(replace(VENDOR, delay_ns=5, timeout_ns=10**9))
        assert message.type is MailboxType.COE
        assert message.data[6:] == b"\x5a\x0e\0\0"
        assert message.counter in range(1, 8)
        (request,) = engine.of(ExchangeMailbox)
        assert (request.request.delay_ns, request.request.timeout_ns) == (5, 10**9)
        assert (request.request.listen, request.request.expects_reply) == (False, True)
        turn.close()
        turn.close()
        assert given == [1]

    play(scene)


def test_errors_are_thrown_into_the_conversation():
    def careful():
        try:
            yield replace(VENDOR, timeout_ns=10**6)
        except MailboxTimeoutError:
            return "late"
        raise AssertionError("it answered")

    async def scene(turn, engine, given):
        engine.buses[0].line.fault(kind="mailbox", slave="drive")
        assert await drive_async(careful(), turn.exchange) == "late"

    play(scene)


@pytest.mark.parametrize(("kind", "farewells"), [(MailboxType.COE, 1), (MailboxType.VOE, 0)])
def test_mailbox_turn_abandoned_ends_the_transfer(kind, farewells):
    async def scene(turn, engine, given):
        asked = replace(VENDOR, expects_reply=False)
        await turn.exchange(asked)
        turn.abandon()
        turn.abandon()
        assert given == [1]
        await settle()
        assert len(engine.of(ExchangeMailbox)) == 1 + farewells

    play(scene, kind)


def test_mailbox_queues_alternate_between_clients():
    order = []

    async def use(queues, client):
        await queues.acquire("x", client)
        order.append(client)
        await asyncio.sleep(0)
        queues.release("x")

    async def play():
        queues = MailboxQueues()
        async with asyncio.TaskGroup() as group:
            for client in "aaaabb":
                group.create_task(use(queues, client))

    run_virtual(play())
    assert "".join(order) == "aababa"


def test_mailbox_queues_of_other_mailboxes_are_free():
    async def play():
        queues = MailboxQueues()
        await queues.acquire("x", 1)
        await asyncio.wait_for(queues.acquire("y", 1), 1)
        queues.release("x")
        await asyncio.wait_for(queues.acquire("x", 2), 1)

    run_virtual(play())


def test_mailbox_queues_pass_a_turn_on_when_its_client_leaves():
    async def play():
        queues = MailboxQueues()
        await queues.acquire("x", 1)
        leaving = asyncio.ensure_future(queues.acquire("x", 2))
        staying = asyncio.ensure_future(queues.acquire("x", 3))
        await asyncio.sleep(0)
        leaving.cancel()
        queues.release("x")
        await asyncio.wait_for(staying, 1)
        late = asyncio.ensure_future(queues.acquire("x", 4))
        last = asyncio.ensure_future(queues.acquire("x", 5))
        await asyncio.sleep(0)
        queues.release("x")
        late.cancel()  # it has its turn already, and does not take it
        await asyncio.wait_for(last, 1)
        for task in (leaving, late):
            with suppress(asyncio.CancelledError):
                await task

    run_virtual(play())
