"""What the engine said of its slaves is good for a moment."""

from __future__ import annotations

import asyncio

from devicebus.errors import BusError
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.appliance.services.gateway.slave_book import FRESH_S, SlaveBook
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


def test_a_bus_that_is_down_has_no_slaves() -> None:
    async def run() -> None:
        for answer in (BusReport(is_up=False), BusError("gone"), EngineGoneError("gone")):
            book = SlaveBook(Engine(answer).describe)
            assert await book.find(1001) is Reason.BUS_DOWN
            assert await book.stations() == ()

    asyncio.run(run())
