"""Order of answers, and limits of the queues."""

from __future__ import annotations

import asyncio

from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, decode_packet
from eap.ids import Endpoint
from eap.services.routing import service as service_module
from eap.services.routing.service import LocalRequest, SerialQueues
from tests.support import aoe
from tests.support.routing import StubService
from tests.support.virtualtime import run_virtual

ONE, OTHER = Endpoint("link", "1"), Endpoint("link", "2")


def request(body: bytes = b"", endpoint: Endpoint = ONE, port: int = 0xFFFF) -> LocalRequest:
    header, data = decode_packet(aoe.packet("1.1.1.1.2.1", aoe.READ, body, port=port))
    return LocalRequest(header, bytes(data), endpoint)


class Slow:
    """Answers when it is told to; remembers what has begun."""

    def __init__(self) -> None:
        self.begun: list[bytes] = []
        self.access_filter = asyncio.Event()

    async def __call__(self, request: LocalRequest) -> AmsAnswer:
        self.begun.append(request.body)
        await self.access_filter.wait()
        return AmsAnswer(request.body)


async def settle() -> None:
    for _ in range(20):
        await asyncio.sleep(0)


def play(script):
    """Run ``script(queues, slow)``; return the answers in their order."""
    answers: list[tuple[int, AmsAnswer]] = []

    async def run():
        queues = SerialQueues(lambda ticket, answer: answers.append((ticket, answer)))
        try:
            await script(queues, Slow())
        finally:
            await queues.close()

    run_virtual(run())
    return answers


def test_queue_finishes_immediate_answers_at_once():
    async def script(queues, slow):
        queues.put(1, StubService(lambda each: AmsAnswer(each.body)), request(b"x"))
        assert asyncio.all_tasks() == {asyncio.current_task()}

    assert play(script) == [(1, AmsAnswer(b"x"))]


def test_requests_of_a_client_to_a_port_keep_their_order_and_others_overtake():
    async def script(queues, slow):
        quick = StubService(lambda each: AmsAnswer(each.body))
        queues.put(1, StubService(slow), request(b"1"))
        queues.put(2, StubService(slow), request(b"2"))
        queues.put(3, quick, request(b"3"))
        queues.put(4, quick, request(b"4", OTHER))
        queues.put(5, quick, request(b"5", port=1001))
        await settle()
        assert slow.begun == [b"1"]
        slow.access_filter.set()
        await settle()
        queues.put(6, quick, request(b"6"))

    assert [ticket for ticket, _ in play(script)] == [4, 5, 1, 2, 3, 6]


def test_queue_answers_excess_requests_with_an_error(monkeypatch):
    monkeypatch.setattr(service_module, "MAX_WAITING", 2)

    async def script(queues, slow):
        for ticket in range(1, 5):
            queues.put(ticket, StubService(slow), request())
        await settle()
        slow.access_filter.set()
        await settle()

    full = AmsAnswer(error_code=AdsError.MAILBOX_FULL)
    assert play(script) == [(4, full)] + [(ticket, AmsAnswer()) for ticket in (1, 2, 3)]


def test_octets_that_wait_are_limited_and_free_again(monkeypatch):
    monkeypatch.setattr(service_module, "MAX_OCTETS", 100)

    async def script(queues, slow):
        service = StubService(slow)
        for _ in range(3):
            for ticket in range(1, 4):
                queues.put(ticket, service, request(bytes(40)))
            queues.forget(ONE)
            slow.access_filter.set()
            await settle()
            slow.access_filter.clear()

    answers = play(script)
    assert [(ticket, each.error_code) for ticket, each in answers] == [
        (3, AdsError.MAILBOX_FULL),
        (1, 0),
    ] * 3


def test_queue_drops_waiting_requests_of_a_closed_connection():
    async def script(queues, slow):
        for ticket, endpoint in ((1, ONE), (2, ONE), (3, OTHER), (4, OTHER)):
            queues.put(ticket, StubService(slow), request(str(ticket).encode(), endpoint))
        queues.forget(ONE)
        slow.access_filter.set()
        await settle()

    assert sorted(ticket for ticket, _ in play(script)) == [1, 3, 4]


def test_service_that_fails_is_answered_for_and_the_next_request_served(caplog):
    def fail(request):
        raise ZeroDivisionError

    async def fail_later(request):
        raise ZeroDivisionError

    async def script(queues, slow):
        for ticket, reply in ((1, fail), (2, fail_later), (3, fail), (4, lambda _: AmsAnswer())):
            queues.put(ticket, StubService(reply), request())
        await settle()

    answers = play(script)
    internal = AdsError.INTERNAL
    assert [(ticket, each.error_code) for ticket, each in answers] == [
        (1, internal),
        (2, internal),
        (3, internal),
        (4, 0),
    ]
    assert caplog.messages == [f"AMS request from {aoe.CLIENT} failed"] * 3


def test_queue_close_cancels_running_requests():
    async def script(queues, slow):
        queues.put(1, StubService(slow), request())
        await settle()

    assert play(script) == []


def test_queue_counts_the_requests_before_one_and_notes_its_receipt():
    seen: list[LocalRequest] = []

    async def script(queues, slow):
        for ticket in range(1, 4):
            queues.put(ticket, StubService(slow), request())
        queues.put(4, StubService(lambda each: seen.append(each) or AmsAnswer()), request())
        queues.put(5, StubService(lambda each: seen.append(each) or AmsAnswer()), request(port=1))
        slow.access_filter.set()
        await settle()

    play(script)
    assert [each.ahead for each in seen] == [0, 3]
    assert [each.queued_ns > 0 for each in seen] == [False, True]
