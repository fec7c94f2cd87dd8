"""The cached description of a bus, on the messages of an engine."""

from __future__ import annotations

import asyncio
import socket

import msgspec
import pytest

from devicebus.wire.alstatus import AlState
from eap.errors import EngineGoneError
from eap.runtime.engine_messages import (
    BringSlaves,
    BusChange,
    DescribeBus,
    Ping,
    Republish,
    SlaveDescription,
)
from eap.services.engine_link import EngineLink
from eap.services.slaves.bus_client import BusView
from tests.support.eventually import elapse
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

LOOK_S = 0.05


def play(scene, *, silence_limit_s=LOOK_S):
    """Run *scene* with a view and the engine behind it."""

    async def run():
        engine = FakeEngine(FakeBus(LoopBus("coe")))
        link = EngineLink(engine.services, silence_limit_s=silence_limit_s)
        try:
            async with asyncio.timeout(10):
                return await scene(BusView(link, 0), engine, link)
        finally:
            link.close()
            engine.close()

    return run_virtual(run())


def slave(station: int, state: int) -> SlaveDescription:
    return SlaveDescription(
        station=station, name="s", vendor=1, product=2, revision=3, serial=4, alias=0,
        state=state, target=8,
    )  # fmt: skip


def change(*slaves: SlaveDescription, stations: tuple[int, ...] = (1001, 1002), bus: int = 0):
    return BusChange(bus=bus, is_up=True, fault="", stations=stations, slaves=slaves)


def test_view_requests_the_engine_once():
    async def scene(view, engine, link):
        assert not view.latest.slaves
        for _ in range(3):
            bus = await view.current()
            assert bus.is_up
            assert list(bus.slaves) == [1001, 1002, 1003]
        assert [type(each) for each in engine.requests] == [Republish]

    play(scene, silence_limit_s=5.0)


def test_view_has_the_state_that_was_requested_when_the_answer_comes():
    async def scene(view, engine, link):
        await view.current()
        await link.request(lambda number: BringSlaves(id=number, bus=0, station=1003, target=1), 1)
        assert view.latest.slaves[1003].state == AlState.INIT
        await link.request(lambda number: BringSlaves(id=number, bus=0, station=1003, target=2), 1)
        assert view.latest.slaves[1003].state == AlState.PREOP
        assert not engine.of(DescribeBus)

    play(scene)


def test_view_confirmed_has_unrequested_changes():
    async def scene(view, engine, link):
        await view.current()
        engine.buses[0].is_up = False
        assert (await view.current()).is_up
        assert not (await view.confirm()).is_up
        assert (await view.current()).fault == "no frame comes back"

    play(scene, silence_limit_s=5.0)


def test_view_of_a_silent_engine_is_confirmed_before_it_is_used():
    async def scene(view, engine, link):
        await view.current()
        await elapse(2 * LOOK_S)
        await view.current()
        assert len(engine.of(Ping)) == 1
        engine.holds = True
        await elapse(2 * LOOK_S)
        with pytest.raises(EngineGoneError):
            await view.current()
        engine.release()
        assert (await view.current()).is_up

    play(scene)


def test_view_is_empty_after_a_restart_of_the_engine_and_requests_again():
    async def scene(view, engine, link):
        await view.current()
        notified = []
        restarted = asyncio.Event()

        def note():
            notified.append(len(view.latest.slaves))
            restarted.set()

        view.on_change.append(note)
        engine.say_hello()
        await restarted.wait()
        assert len((await view.current()).slaves) == 3
        assert (notified[0], {*notified[1:]}) == (0, {3})
        assert len(engine.of(Republish)) == 2

    play(scene)


class Pair:
    """A view behind a socket to which a test writes messages of an engine."""

    def __init__(self) -> None:
        self.engine, services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link = EngineLink(services, silence_limit_s=5.0)
        self.view = BusView(self.link, 0)

    async def send(self, *messages: object) -> None:
        for message in messages:
            self.engine.send(msgspec.msgpack.encode(message))
        for _ in range(3):
            await asyncio.sleep(0)

    def states(self) -> dict[int, int]:
        return {station: each.state for station, each in self.view.latest.slaves.items()}

    def close(self) -> None:
        self.link.close()
        self.engine.close()


def with_pair(scene) -> None:
    async def run() -> None:
        pair = Pair()
        try:
            async with asyncio.timeout(10):
                await scene(pair)
        finally:
            pair.close()

    run_virtual(run())


def test_view_merges_slaves_that_have_changed_in_the_order_of_the_bus():
    async def scene(pair):
        await pair.send(change(slave(1001, 2), slave(1002, 2)), change(slave(1002, 4)))
        assert pair.states() == {1001: 2, 1002: 4}
        await pair.send(change(slave(1003, 1), stations=(1003, 1001)))
        assert list(pair.states().items()) == [(1003, 1), (1001, 2)]
        await pair.send(change(slave(1001, 8), bus=1))
        assert pair.states() == {1003: 1, 1001: 2}

    with_pair(scene)


def test_view_without_earlier_messages_shows_no_part_of_a_bus():
    async def scene(pair):
        await pair.send(change(slave(1002, 4)))
        assert not pair.states()
        asking = asyncio.ensure_future(pair.view.current())
        await asyncio.sleep(0)
        request = msgspec.msgpack.decode(pair.engine.recv(100), type=Republish)
        await pair.send(
            change(slave(1001, 2), slave(1002, 4)), {"type": "answer", "id": request.id}
        )
        assert list((await asking).slaves) == [1001, 1002]

    with_pair(scene)


def test_view_does_not_trust_an_answer_without_a_description():
    async def scene(pair):
        asking = asyncio.ensure_future(pair.view.current())
        await asyncio.sleep(0)
        request = msgspec.msgpack.decode(pair.engine.recv(100), type=Republish)
        await pair.send({"type": "answer", "id": request.id})
        with pytest.raises(EngineGoneError, match="no report from the engine"):
            await asking

    with_pair(scene)
