"""ADS requests of which each operation takes its time."""

from __future__ import annotations

import asyncio
import struct

from eap.ads.request import OperationOutcome
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsCommand
from eap.services.ads.ads_service import answer_request, begin_answer
from tests.support.virtualtime import run_virtual

OK = bytes(4)


async def echo(operation):
    await asyncio.sleep(0)
    if operation.group == 9:
        return OperationOutcome(AdsError.ACCESS, why=f"not {operation.offset}")
    return OperationOutcome(data=operation.offset.to_bytes(4, "little")[: operation.length])


def ask(command, body):
    return run_virtual(answer_request(command, body, echo))


def sum_read(*places):
    items = b"".join(struct.pack("<3I", *place) for place in places)
    return struct.pack("<4I", IndexGroup.SUM_READ_EX_2, len(places), 4096, len(items)) + items


def test_ads_request_of_one_operation_is_answered():
    got = ask(AmsCommand.READ, struct.pack("<3I", 1, 5, 2))
    assert got == AmsAnswer(OK + b"\2\0\0\0" + b"\5\0")


def test_items_of_a_sum_are_done_one_by_one():
    body = sum_read((1, 6, 1), (9, 8, 1))
    got = ask(AmsCommand.READ_WRITE, body)
    heads = struct.pack("<4I", 0, 1, AdsError.ACCESS, 0)
    assert got == AmsAnswer(OK + struct.pack("<I", 17) + heads + b"\6", why="not 8")


def test_operation_without_waiting_is_answered_at_once():
    def at_once(operation):
        return OperationOutcome(data=b"\7")

    body = struct.pack("<3I", 1, 5, 2)
    assert begin_answer(AmsCommand.READ, body, at_once) == AmsAnswer(OK + b"\1\0\0\0\7")
    assert begin_answer(AmsCommand.READ, b"", at_once) == AmsAnswer(b"\5\7\0\0" + OK)
    asked = sum_read((1, 6, 1), (1, 7, 1))
    later = begin_answer(AmsCommand.READ_WRITE, asked, at_once)
    assert run_virtual(later).data.endswith(b"\7\7")


def test_malformed_ads_request_is_answered_with_an_error():
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

    run_virtual(run())
    assert seen == list(range(200))
