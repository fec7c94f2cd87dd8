"""Requests of a station to itself, and to others by its routes."""

from __future__ import annotations

import asyncio

from eap.ads.endpoint import AmsAnswer
from eap.codec.ads import AdsError
from eap.ids import NetId
from tests.support import aoe
from tests.support.routing import echo, station, while_serving

TARGET = NetId.parse("1.1.1.1.2.1")


def test_requests_side_by_side_get_their_own_answers():
    async def slow(request):
        for _ in range(request.body[0]):
            await asyncio.sleep(0)
        return echo(request)

    there = station(reply=slow)

    async def script():
        return await asyncio.gather(
            *(there.request(TARGET, 0xFFFF, aoe.READ, bytes([n]), timeout_s=1) for n in (9, 5, 1))
        )

    answers = asyncio.run(while_serving(script(), there))
    assert answers == [AmsAnswer(bytes([0, 0, 0, 0, 2, n])) for n in (9, 5, 1)]
    assert there.record.connections.snapshot() == {}


def test_errors_are_answers():
    there = station()

    async def script():
        return [
            await there.request(TARGET, 1, aoe.READ, timeout_s=1),
            await there.request(NetId.parse("9.9.9.9.9.9"), 1, aoe.READ, timeout_s=1),
        ]

    answers = asyncio.run(while_serving(script(), there))
    assert [each.error_code for each in answers] == [6, 7]


def test_local_client_time_out_is_an_error_and_drops_the_late_answer():
    access_filter = asyncio.Event()

    async def slow(request):
        await access_filter.wait()
        return AmsAnswer()

    there = station(reply=slow)

    async def script():
        answer = await there.request(TARGET, 0xFFFF, aoe.READ, timeout_s=0.01)
        access_filter.set()
        await asyncio.sleep(0)
        return answer

    assert asyncio.run(while_serving(script(), there)) == AmsAnswer(error_code=AdsError.TIMEOUT)
    assert there.stats().in_flight == 0
