"""The desk of a master: what its dictionary shows is not old when it is asked for."""

from __future__ import annotations

import asyncio

from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.gateway.master_session import MasterSession
from eap.appliance.services.master.master_desk import MasterDesk
from eap.codec.mailbox import MailboxType
from eap.od.model import OdState
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus


def test_a_master_tells_of_its_bus() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        desk = MasterDesk(BusClient(link, [PORT]), PORT, "1.0")
        try:
            await desk.refresh(0xA000)
            read = desk.dictionary.upload
            assert read(0x1008, 0, OdState.OP) == b"EtherCAT master left/bus0"
            assert read(0xF020, 1, OdState.OP) == b"\xe9\x03"
            assert read(0xA000, 1, OdState.OP) == b"\2\0"
            session = MasterSession(desk.dictionary, 1000, desk.refresh, desk.is_fresh)
            (reply,) = await session.ask(MailboxType.COE, bytes.fromhex("0020 40 0080 01 00000000"))
            assert reply.body.hex() == "0030" + "4b" + "0080" + "01" + "e9030000"
        finally:
            link.close()
            engine.close()

    asyncio.run(run())
