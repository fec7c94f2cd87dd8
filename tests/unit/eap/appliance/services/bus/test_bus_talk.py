"""A turn at a mailbox; conversations led in it are in test_bus_client."""

from __future__ import annotations

import asyncio

import pytest
from msgspec.structs import replace

from devicebus.drive import drive_async
from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import MailboxRequest
from eap.appliance.bus_request import AskMailbox
from eap.appliance.services.bus.bus_talk import Talk
from eap.appliance.services.engine_link import EngineLink
from eap.codec.mailbox import MailboxType
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus

VENDOR = MailboxRequest(MailboxType.COE, bytes.fromhex("00204018100100000000"))


def play(scene, kind=MailboxType.COE):
    """Run *scene* with a turn, the engine, and the list to which giving back adds."""

    async def run():
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        given = []
        try:
            await scene(Talk(link, 0, 1001, kind, lambda: given.append(1)), engine, given)
        finally:
            link.close()
            engine.close()

    asyncio.run(run())


def test_step_as_it_was_asked_for():
    async def scene(talk, engine, given):
        message = await talk.ask(replace(VENDOR, delay_ns=5, timeout_ns=10**9))
        assert message.type is MailboxType.COE
        assert message.data[6:] == b"\x5a\x0e\0\0"
        assert message.counter in range(1, 8)
        (request,) = engine.of(AskMailbox)
        assert (request.delay_ns, request.timeout_ns) == (5, 10**9)
        assert (request.listen, request.expects_reply) == (False, True)
        talk.close()
        talk.close()
        assert given == [1]

    play(scene)


def test_errors_are_thrown_into_the_conversation():
    def careful():
        try:
            yield replace(VENDOR, timeout_ns=10**6)
        except MailboxTimeoutError:
            return "late"
        raise AssertionError("it answered")

    async def scene(talk, engine, given):
        engine.buses[0].line.fault(kind="mailbox", slave="drive")
        assert await drive_async(careful(), talk.ask) == "late"

    play(scene)


@pytest.mark.parametrize(("kind", "farewells"), [(MailboxType.COE, 1), (MailboxType.VOE, 0)])
def test_abandoned(kind, farewells):
    async def scene(talk, engine, given):
        asked = replace(VENDOR, expects_reply=False)
        await talk.ask(asked)
        talk.abandon()
        talk.abandon()
        assert given == [1]
        await asyncio.sleep(0.01)
        assert len(engine.of(AskMailbox)) == 1 + farewells

    play(scene, kind)
