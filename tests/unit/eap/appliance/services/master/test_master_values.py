"""What the master tells of slaves in memory."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import msgspec
import pytest

from eap.appliance.bus_request import BringSlaves, ExchangeDatagrams, ExchangeMailbox
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.engine_link import EngineLink
from eap.appliance.services.master.master_values import FRESH_S, MasterView
from eap.od.abort import SdoAbortError
from eap.od.profiles.master1100 import Live
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus


def play(scene: Callable[[MasterView, FakeEngine], Awaitable[None]], bus: str = "io") -> None:
    async def run() -> None:
        engine = FakeEngine(FakeBus(LoopBus(bus)))
        link = EngineLink(engine.services)
        view = MasterView(BusClient(link, [PORT]), PORT)
        try:
            await scene(view, engine)
        finally:
            link.close()
            engine.close()

    asyncio.run(run())


async def soon(condition: Callable[[], bool]) -> None:
    for _ in range(5000):
        if condition():
            return
        await asyncio.sleep(0.001)
    pytest.fail("it does not happen")


def test_what_is_configured_and_what_is_there() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        assert view.configured() == ()
        await view.refresh(with_registers=True)
        assert view.configured() == view.detected() == (1001, 1002, 1003, 1004)
        assert view.of_configured(1001, Live.NAME) == "coupler"
        assert view.of_configured(1009, Live.NAME) == ""
        assert view.of_configured(1009, Live.VENDOR) == 0
        assert view.of_detected(1002, Live.DL_STATUS)
        assert view.of_detected(1002, Live.VENDOR) == view.of_configured(1002, Live.VENDOR)
        assert view.of_diagnosis(1001, Live.AL_STATUS) == 2
        assert view.of_diagnosis(1009, Live.AL_STATUS) == 0
        assert view.of_master(Live.STATE) == 2

    play(scene)


def test_who_is_wired_to_whom() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(with_registers=True)
        ports = (Live.NEIGHBOUR_0, Live.NEIGHBOUR_1, Live.NEIGHBOUR_2, Live.NEIGHBOUR_3)
        wired = [[view.of_diagnosis(at, port) for port in ports] for at in (1001, 1002, 1004)]
        assert wired == [[0, 1002, 1004, 0], [1001, 1003, 0, 0], [1001, 0, 0, 0]]

    play(scene)


def test_one_look_serves_all_who_ask_at_once() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await asyncio.gather(*(view.refresh(with_registers=True) for _ in range(9)))
        looks = len(engine.of(ExchangeDatagrams))
        await view.refresh(with_registers=True)
        assert len(engine.of(ExchangeDatagrams)) == looks
        await asyncio.sleep(FRESH_S + 0.01)
        await view.refresh(with_registers=False)
        await view.refresh(with_registers=True, place=0)  # links of the configuration
        assert len(engine.of(ExchangeDatagrams)) == looks
        await view.refresh(with_registers=True)
        assert len(engine.of(ExchangeDatagrams)) > looks

    play(scene)


def test_a_scan_is_started_by_a_write() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(with_registers=False)
        view.write_master(Live.DETECT_REQUEST, b"\1\0")
        view.write_master(Live.DETECT_REQUEST, b"\1\0")
        assert view.of_master(Live.DETECT_STATUS) == 255
        await soon(lambda: view.of_master(Live.DETECT_STATUS) == 1)
        assert view.of_master(Live.DETECT_RESPONSE) == bytes((1, 0, 0, 0, 4, 0))
        assert view.of_detected(1001, Live.ADDRESS) == 1001
        assert view.of_detected(1001, Live.PRODUCT) == view.of_configured(1001, Live.PRODUCT)

    play(scene)


def test_states_and_loops_are_written() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        await view.refresh(with_registers=True)
        view.write_slave(1001, Live.AL_CONTROL, 1)
        await soon(lambda: bool(engine.of(BringSlaves)))
        assert engine.of(BringSlaves)[0].target == 1
        assert view.of_diagnosis(1001, Live.AL_CONTROL) == 1
        for value in (0, 5, 99):
            with pytest.raises(SdoAbortError, match=f"{value:#x} asks for no AL state"):
                view.write_slave(1001, Live.AL_CONTROL, value)
        view.write_slave(1004, Live.LINK_CONTROL, 0x0C)
        await asyncio.sleep(0.01)
        await view.refresh(with_registers=True)
        assert view.of_diagnosis(1004, Live.LINK_CONTROL) == 0x0C
        view.write_slave(1004, Live.FIXED_LINKS, 1)
        assert view.of_diagnosis(1004, Live.FIXED_LINKS) is True
        view.write_slave(1004, Live.FIXED_LINKS, 0)
        assert view.of_diagnosis(1004, Live.FIXED_LINKS) is False

    play(scene)


def test_counters_begin_again_at_a_reset() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        def total() -> int:
            ports = (Live.CRC_0, Live.CRC_1, Live.CRC_2, Live.CRC_3)
            return sum(view.of_diagnosis(at, port) for at in view.configured() for port in ports)

        engine.buses[0].line.fault(kind="corrupt", slave="inputs", every=3)
        await view.refresh(with_registers=True)
        await asyncio.sleep(FRESH_S + 0.01)
        await view.refresh(with_registers=True)
        view.write_master(Live.RESET, b"\0")
        assert total() > 0, "only a rising edge resets"
        view.write_master(Live.RESET, b"\1")
        assert total() == 0

    play(scene)


def test_what_the_master_counts_is_shown_since_a_reset() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        past = (Live.ABSENCES, Live.ABNORMAL_CHANGES, Live.AL_STATUS_CODE)

        async def shown() -> list[int]:
            await asyncio.sleep(FRESH_S + 0.01)
            await view.refresh(with_registers=True)
            return [view.of_diagnosis(1002, key) for key in past]

        report = engine.buses[0].report()

        def happens(**what: int) -> None:
            slaves = [
                msgspec.structs.replace(slave, **what) if slave.station == 1002 else slave
                for slave in report.slaves
            ]
            engine.buses[0].report = lambda: msgspec.structs.replace(report, slaves=tuple(slaves))

        happens(losses=2, departures=1, al_code=0x1B)
        assert await shown() == [2, 1, 0x1B]
        view.write_master(Live.RESET, b"\1")
        assert await shown() == [0, 0, 0]
        happens(losses=2, departures=2, al_code=0x1E)
        assert await shown() == [0, 1, 0x1E]

    play(scene)


def test_slaves_are_asked_for_their_device_type_once() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        assert not view.is_fresh(with_registers=False, place=0)
        await asyncio.gather(*(view.refresh(with_registers=False, place=0) for _ in range(3)))
        assert view.of_configured(1001, Live.DEVICE_TYPE) == 0x0002_0192
        assert view.of_configured(1001, Live.TYPE) == "drive"
        asked = len(engine.of(ExchangeMailbox))
        await asyncio.sleep(FRESH_S + 0.01)
        await view.refresh(with_registers=False, place=0)
        assert view.is_fresh(with_registers=False, place=0)
        assert view.is_fresh(with_registers=False, place=9), "there is none that could be asked"
        assert len(engine.of(ExchangeMailbox)) == asked

    play(scene, "drive")


def test_a_bus_that_is_down_shows_nothing() -> None:
    async def scene(view: MasterView, engine: FakeEngine) -> None:
        engine.buses[0].is_up = False
        await view.refresh(with_registers=True)
        assert view.configured() == view.detected() == ()
        assert view.of_master(Live.STATE) == 1

    play(scene)
