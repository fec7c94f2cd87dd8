"""ADS requests of which each operation takes its time."""

from __future__ import annotations

import asyncio
import struct

from eap.aoe.ads_operation import OperationOutcome, Read
from eap.aoe.answer import AmsAnswer
from eap.appliance.services.ads_requests import answer_request
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsCommand

OK = bytes(4)


async def echo(operation):
    await asyncio.sleep(0)
    if operation.group == 9:
        return OperationOutcome(AdsError.ACCESS, why=f"not {operation.offset}")
    return OperationOutcome(data=operation.offset.to_bytes(4, "little")[: operation.length])


def ask(command, body, **more):
    return asyncio.run(answer_request(command, body, echo, **more))


def sum_read(*places):
    items = b"".join(struct.pack("<3I", *place) for place in places)
    return struct.pack("<4I", IndexGroup.SUM_READ_EX_2, len(places), 4096, len(items)) + items


def test_one_operation():
    got = ask(AmsCommand.READ, struct.pack("<3I", 1, 5, 2))
    assert got == AmsAnswer(OK + b"\2\0\0\0" + b"\5\0")


def test_items_of_a_sum_are_judged_and_done_one_by_one():
    def judge(operation):
        return AdsError.ACCESS_DENIED if operation == Read(1, 7, 4) else AdsError.NONE

    body = sum_read((1, 6, 1), (1, 7, 4), (9, 8, 1))
    got = ask(AmsCommand.READ_WRITE, body, judge=judge)
    heads = struct.pack("<6I", 0, 1, AdsError.ACCESS_DENIED, 0, AdsError.ACCESS, 0)
    assert got == AmsAnswer(OK + struct.pack("<I", 25) + heads + b"\6", why="not 8")


def test_what_is_no_request():
    assert ask(99, b"") == AmsAnswer(error_code=AdsError.COMMAND)


def test_others_have_a_turn_in_a_long_one():
    seen = []

    async def at_once(operation):
        seen.append(operation.offset)
        return OperationOutcome()

    async def run():
        body = sum_read(*((1, n, 1) for n in range(200)))
        asking = asyncio.ensure_future(answer_request(AmsCommand.READ_WRITE, body, at_once))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert len(seen) < 200
        await asking

    asyncio.run(run())
    assert seen == list(range(200))
