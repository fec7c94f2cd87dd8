"""Link of services to the engine."""

from __future__ import annotations

import asyncio

import pytest

from devicebus.errors import BusError
from eap.errors import EngineGoneError
from eap.runtime.engine_messages import Cancel, DescribeBus, EngineStarted
from eap.services.engine_link import EngineLink
from tests.support.eventually import elapse, settle
from tests.support.fakeengine import FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual


def play(scene, *buses, silence_limit_s=1.0):
    """Run *scene* with an engine and the link to it."""

    async def run():
        engine = FakeEngine(*buses)
        link = EngineLink(engine.services, silence_limit_s=silence_limit_s)
        try:
            async with asyncio.timeout(10):
                return await scene(engine, link)
        finally:
            link.close()
            engine.close()

    return run_virtual(run())


def describe(bus=0):
    return lambda number: DescribeBus(id=number, bus=bus)


def tell_often(link):
    for _ in range(100_000):
        link.send(describe())


def test_answers_are_matched_by_number():
    async def scene(engine, link):
        engine.holds = True
        asked = [asyncio.ensure_future(link.request(describe(), 1)) for _ in range(3)]
        await settle()
        engine._held.reverse()
        engine.release()
        answers = await asyncio.gather(*asked)
        assert [each.id for each in answers] == [each.id for each in engine.requests]
        assert all(each.report.is_up for each in answers)

    play(scene, FakeBus(LoopBus("drive")))


def test_failure_is_raised():
    async def scene(engine, link):
        with pytest.raises(BusError, match="no such bus"):
            await link.request(describe(7), 1)

    play(scene)


def test_silent_engine_is_gone():
    async def scene(engine, link):
        engine.holds = True
        with pytest.raises(EngineGoneError, match="does not answer"):
            await link.request(describe(), 60)
        await settle()
        assert engine.of(Cancel)[0].id == engine.requests[0].id

    play(scene, silence_limit_s=0.02)


def test_slow_engine_that_answers_others_is_not_gone():
    async def scene(engine, link):
        engine.holds = True
        asked = asyncio.ensure_future(link.request(describe(), 60))
        await settle()
        slow, engine._held, engine.holds = list(engine._held), [], False
        for _ in range(10):
            await elapse(0.02)
        assert not asked.done()
        engine._held = slow
        engine.release()
        assert (await asked).report.is_up

    play(scene, FakeBus(LoopBus("drive")), silence_limit_s=0.02)


def test_time_out_of_its_own():
    async def scene(engine, link):
        engine.holds = True
        with pytest.raises(EngineGoneError):
            await link.request(describe(), 0.02)

    play(scene)


def test_new_engine_fails_what_waits():
    async def scene(engine, link):
        restarts = []
        link.on_restart.append(lambda: restarts.append(True))
        engine.holds = True
        asked = asyncio.ensure_future(link.request(describe(), 60))
        await settle()
        engine.say_hello()
        with pytest.raises(EngineGoneError, match="started again"):
            await asked
        assert restarts == [True]

    play(scene)


def test_cancelled_request_is_cancelled_at_the_engine():
    async def scene(engine, link):
        engine.holds = True
        asked = asyncio.ensure_future(link.request(describe(), 60))
        await settle()
        asked.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asked
        await settle()
        assert [type(each) for each in engine.requests] == [DescribeBus, Cancel]
        assert engine.requests[0].id == engine.requests[1].id
        engine.release()  # an answer that no request waits for does no harm
        await settle()
        assert (await link.request(describe(), 1)).report.is_up

    play(scene, FakeBus(LoopBus("drive")))


def test_engine_that_reads_no_messages_is_gone():
    async def scene(engine, link):
        asyncio.get_running_loop().remove_reader(engine._sock)
        with pytest.raises(EngineGoneError, match="accepts no requests"):
            tell_often(link)

    play(scene)


def test_invalid_message_is_logged_and_dropped(caplog):
    async def scene(engine, link):
        engine._sock.send(b"what")
        engine._send(EngineStarted(2))
        await settle()
        assert "message of the engine dropped" in caplog.text

    play(scene)


def test_end_of_the_pair():
    async def scene(engine, link):
        engine._sock.shutdown(2)
        await settle()
        with pytest.raises(EngineGoneError):
            link.send(describe())

    play(scene)
