"""What the engine said of its slaves is good for a moment."""

from __future__ import annotations

import asyncio

import msgspec

from devicebus.errors import BusError
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.appliance.services.gateway.slave_book import FRESH_S, REFUSAL_FRESH_S, SlaveBook
from eap.errors import EngineGoneError
from eap.gateway.refusal import Reason


def slave(station: int) -> SlaveReport:
    return SlaveReport(
        station=station,
        name="s",
        vendor=1,
        product=2,
        revision=3,
        serial=4,
        alias=0,
        state=8,
        target=8,
        to_slave=128,
        to_master=128,
    )


class Engine:
    def __init__(self, *answers: BusReport | Exception) -> None:
        self.answers = list(answers)
        self.asked = 0

    async def describe(self) -> BusReport:
        self.asked += 1
        await asyncio.sleep(0)
        answer = self.answers[min(self.asked, len(self.answers)) - 1]
        if isinstance(answer, Exception):
            raise answer
        return answer


UP = BusReport(is_up=True, slaves=(slave(1002), slave(1001)))


def test_all_who_ask_at_once_cause_one_question() -> None:
    async def run() -> None:
        engine = Engine(UP)
        book = SlaveBook(engine.describe)
        found = await asyncio.gather(*(book.find(1001) for _ in range(5)), book.stations())
        assert found == [slave(1001)] * 5 + [(1002, 1001)]
        assert await book.find(1003) is Reason.NO_SLAVE
        assert engine.asked == 1

    asyncio.run(run())


def test_it_asks_again_after_a_moment() -> None:
    async def run() -> None:
        engine = Engine(UP, BusReport(is_up=True, slaves=(slave(7),)))
        book = SlaveBook(engine.describe)
        assert await book.stations() == (1002, 1001)
        await asyncio.sleep(FRESH_S + 0.01)
        assert await book.stations() == (7,)

    asyncio.run(run())


def test_who_is_to_be_refused_is_looked_for_again() -> None:
    async def run() -> None:
        in_init = msgspec.structs.replace(slave(1001), state=1, to_slave=0, to_master=0)
        down = BusReport(is_up=False)
        engine = Engine(BusReport(is_up=True, slaves=(in_init,)), down, UP)
        book = SlaveBook(engine.describe)
        assert await book.find(1001) == in_init
        assert await book.find(1001) == in_init
        assert engine.asked == 1
        for expected in (Reason.BUS_DOWN, slave(1001)):
            await asyncio.sleep(REFUSAL_FRESH_S + 0.01)
            assert await book.find(1001) == expected
        assert await book.find(1001) == slave(1001)
        assert engine.asked == 3

    asyncio.run(run())


def test_a_bus_that_is_down_has_no_slaves() -> None:
    async def run() -> None:
        for answer in (BusReport(is_up=False), BusError("gone"), EngineGoneError("gone")):
            book = SlaveBook(Engine(answer).describe)
            assert await book.find(1001) is Reason.BUS_DOWN
            assert await book.stations() == ()

    asyncio.run(run())
