"""Mailboxes of one bus port."""

from __future__ import annotations

import asyncio

from devicebus.mailbox import coe_client
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.slaves.bus_mailboxes import BusMailboxes
from eap.codec.mailbox import MailboxType
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus


def test_bus_mailboxes_name_their_port_in_each_request() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        port = BusMailboxes(BusClient(link, [PORT]), PORT)
        try:
            assert list((await port.view.current()).slaves) == [1001]
            talk = await port.open_turn(1001, MailboxType.COE, "me")
            talk.close()
            vendor = await port.converse(1001, coe_client.upload(0x1018, 1), "me")
            assert vendor == bytes.fromhex("5a0e0000")
        finally:
            link.close()
            engine.close()

    asyncio.run(run())
