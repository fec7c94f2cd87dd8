"""Gateways of an appliance; that they answer is in tests/integration/test_gateway.py."""

from __future__ import annotations

import asyncio

from eap.appliance.handover import BusSocket, Handover, PortName
from eap.appliance.services.bus_client import BusClient
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.gateway.opening import MasterDesk, open_gateways
from eap.codec.mailbox import MailboxType
from eap.od.model import OdState
from tests.support.cyclic import bus_port, eap_port, station
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus


def test_each_station_has_one_to_its_first_bus() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        ports = (eap_port(), bus_port("bus0"), bus_port("bus1"))
        names = [PortName("left", "bus0"), PortName("left", "bus1")]
        handover = Handover(
            supervisor=1, folder="", plant="p", plant_file="",
            stations=(station(name="left", ports=ports), station(name="right")),
            sockets=(), buses=tuple(BusSocket(owner=name) for name in names),
        )  # fmt: skip
        try:
            gateways = open_gateways(handover, BusClient(link, names), "1.0")
            assert list(gateways) == ["left"]
        finally:
            link.close()
            engine.close()

    asyncio.run(run())


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
            session = desk.open_session(1000)
            (reply,) = await session.ask(MailboxType.COE, bytes.fromhex("0020 40 0080 01 00000000"))
            assert reply.body.hex() == "0030" + "4b" + "0080" + "01" + "e9030000"
        finally:
            link.close()
            engine.close()

    asyncio.run(run())
