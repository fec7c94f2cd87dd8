"""Gateways of an appliance; that they answer is in tests/integration/test_gateway.py."""

from __future__ import annotations

import asyncio

from eap.appliance.handover import BusSocket, Handover, PortName
from eap.appliance.services.bus_client import BusClient
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.gateway.master_desk import MasterDesk
from eap.appliance.services.gateway.opening import open_gateways
from tests.support.cyclic import bus_port, eap_port, station
from tests.support.fakeengine import FakeBus, FakeEngine
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
            client = BusClient(link, names)
            desks = {name: MasterDesk(client, name, "1.0") for name in names}
            gateways = open_gateways(handover, client, desks)
            assert list(gateways) == ["left"]
        finally:
            link.close()
            engine.close()

    asyncio.run(run())
