"""Gateways of an appliance; that they answer is in tests/integration/test_gateway.py."""

from __future__ import annotations

from msgspec.structs import replace

from eap.pd.spec import GatewayAddress, GatewaySpec
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.engine_link import EngineLink
from eap.services.gateway.opening import follow_settings, open_gateway
from eap.services.slaves.bus_client import BusClient
from eap.services.tasks import TaskSet
from tests.support.cyclic import bus_port
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.routing import station as router
from tests.support.virtualtime import run_virtual

TOLD = GatewaySpec(
    enabled=False,
    answer_ms=250,
    silent=True,
    full=True,
    addresses=(GatewayAddress(0x9000, station=1001), GatewayAddress(0x9001, members=(1001,))),
    in_flight=3,
)


def test_gateway_is_as_the_plant_file_says() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        client = BusClient(link, 0, PORT)
        provider = MasterDictionaryProvider(client, "1.0")
        there = router("5.1.1.1.1.1")
        try:
            first = open_gateway(client, replace(bus_port(), gateway=TOLD), provider, there)
            second = open_gateway(client, bus_port(), provider, there)
            assert (first.is_open, second.is_open) == (False, True)
            assert (first.settings.answer_s, first.settings.is_silent) == (0.25, True)
            assert first.settings.limits.in_flight == 3
            assert first.settings.name == "left/bus0"
        finally:
            link.close()
            engine.close()

    run_virtual(run())


def test_gateway_follows_other_settings() -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus("drive")))
        link = EngineLink(engine.services)
        client, tasks = BusClient(link, 0, PORT), TaskSet("test")
        provider = MasterDictionaryProvider(client, "1.0")
        gateway = open_gateway(client, bus_port(), provider, router("5.1.1.1.1.1"))

        def follow(old: GatewaySpec, new: GatewaySpec) -> bool:
            follow_settings(gateway, old, replace(bus_port(), gateway=new), tasks)
            return gateway.is_open

        try:
            assert follow(GatewaySpec(), GatewaySpec(answer_ms=250))
            assert gateway.settings.answer_s == 0.25
            assert not follow(GatewaySpec(answer_ms=250), GatewaySpec(enabled=False))
            assert not follow(GatewaySpec(enabled=False), GatewaySpec(enabled=False, rate=5))
            assert follow(GatewaySpec(enabled=False), GatewaySpec())
            gateway.is_open = False  # by a command
            assert not follow(GatewaySpec(), GatewaySpec(rate=5))
        finally:
            await tasks.close()
            link.close()
            engine.close()

    run_virtual(run())
