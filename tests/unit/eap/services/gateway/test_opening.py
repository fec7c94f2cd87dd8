"""Gateways of an appliance; that they answer is in tests/integration/test_gateway.py."""

from __future__ import annotations

from msgspec.structs import replace

from eap.od.model import OdState
from eap.pd.spec import GatewayAddress, GatewaySpec
from eap.runtime.handover import BusSocket, Handover, PortName
from eap.services.engine_link import EngineLink
from eap.services.gateway.opening import open_dictionaries, open_gateways
from eap.services.slaves.bus_client import open_buses
from tests.support.cyclic import bus_port, eap_port, station
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.routing import station as router
from tests.support.virtualtime import run_virtual

NAMES = [PortName("left", "bus0"), PortName("left", "bus1")]
BUSES = tuple(BusSocket(name, number) for number, name in enumerate(NAMES))
TOLD = GatewaySpec(
    enabled=False,
    answer_ms=250,
    silent=True,
    full=True,
    addresses=(GatewayAddress(0x9000, station=1001), GatewayAddress(0x9001, members=(1001,))),
    in_flight=3,
)


def test_each_bus_has_one_as_the_plant_file_says() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")), FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        ports = (eap_port(), replace(bus_port("bus0"), gateway=TOLD), bus_port(name="bus1"))
        handover = Handover(
            supervisor=1, folder="", plant="p", plant_file="",
            stations=(station(name="left", ports=ports), station(name="right")),
            sockets=(), buses=BUSES,
        )  # fmt: skip
        try:
            clients = open_buses(link, BUSES)
            providers = open_dictionaries(handover, clients, "1.0")
            gateways = open_gateways(handover, clients, providers, {"left": router("5.1.1.1.1.1")})
            assert list(gateways) == NAMES
            first, second = gateways.values()
            assert (first.is_open, second.is_open) == (False, True)
            assert (first.settings.answer_s, first.settings.is_silent) == (0.25, True)
            assert first.settings.limits.in_flight == 3
            extents = []
            for provider in providers.values():
                await provider.refresh(0xA000)
                extents.append(provider.dictionary.upload(0xA000, 0, OdState.OP)[0])
            assert extents == [19, 17]
        finally:
            link.close()
            engine.close()

    run_virtual(run())
