"""Requests to other routers, and matching of their answers."""

from __future__ import annotations

import asyncio
import socket

import pytest

from eap.codec.amsdiscovery import (
    DiscoveryHeader,
    Tag,
    decode_discovery,
    decode_text,
    encode_discovery,
)
from eap.errors import EnvironmentalError
from eap.ids import NetId
from eap.services.routing import remote_routers as module
from eap.services.routing.remote_routers import (
    RemoteRouter,
    RemoteRouteRequest,
    RouterRequests,
    network_of,
)

pytestmark = pytest.mark.net

OWN = NetId.parse("1.1.1.1.1.1")
MILL, SAW = NetId.parse("2.2.2.2.1.1"), NetId.parse("3.3.3.3.1.1")
INFO, ADD_ROUTE = 0x8000_0001, 0x8000_0006
THERE = "127.0.0.2"
WANTED = RemoteRouteRequest("left", OWN, "Administrator", "1")


@pytest.fixture
def questions():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield RouterRequests(sock, [OWN])


def answer(number, net_id, *tags, service=INFO):
    header = DiscoveryHeader(0, number, service, net_id, 10_000)
    return encode_discovery(header, tags)


def play(questions, ask, answers, sender=THERE):
    """Let *ask* ask one other socket; return the question, what came of it, and what was taken.

    Args:
        questions: Of which *ask* is a method.
        ask: Called with the UDP port of the other.
        answers: Makes datagrams of the number of the question.
        sender: Whose they are.
    """

    async def run():
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind((THERE, 0))
            other.setblocking(False)
            asking = asyncio.create_task(ask(other.getsockname()[1]))
            data = await asyncio.wait_for(loop.sock_recv(other, 300), 5)
            question = decode_discovery(data)
            number = question.header.invoke_id
            taken = [questions.receive(each, sender) for each in answers(number)]
            return question, await asking, taken

    return asyncio.run(run())


def scan(questions, answers):
    return play(questions, lambda port: questions.scan(THERE, wait_s=0.1, port=port), answers)


def add_remote_route(questions, answers, **more):
    def ask(port):
        return questions.add_remote_route(WANTED, THERE, wait_s=0.3, port=port)

    return play(questions, ask, answers, **more)


def test_scan_returns_each_answering_router_once(questions):
    def answers(number):
        version = (Tag.VERSION, b"\3\1\xb8\x0f")
        yield answer(number, MILL, (Tag.HOST, b"mi\x1bll\0"), version)
        yield answer(number, MILL, (Tag.HOST, b"again\0"))
        yield answer(number, OWN)
        yield answer(number, NetId(bytes(6)))
        yield answer(0, SAW)  # from who knows no numbers

    question, found, taken = scan(questions, answers)
    assert found == [
        RemoteRouter("mill", MILL, THERE, "3.1.4024"),
        RemoteRouter("", SAW, THERE, ""),
    ]
    assert (question.header.service, question.header.net_id) == (1, OWN)
    assert all(taken)


def test_requests_ignore_unmatched_datagrams(questions):
    def answers(number):
        yield answer(number ^ 1, MILL)
        yield answer(number, MILL, service=ADD_ROUTE)
        yield answer(number, MILL, service=1)
        yield b"?"

    _, found, taken = scan(questions, answers)
    assert (found, taken) == ([], [False] * 4)
    assert not questions.receive(answer(0, MILL), THERE)  # too late


def test_scan_limits_the_number_of_routers(questions, monkeypatch):
    monkeypatch.setattr(module, "MAX_ROUTERS", 1)
    _, found, _ = scan(questions, lambda number: [answer(number, MILL), answer(number, SAW)])
    assert [each.net_id for each in found] == [MILL]


@pytest.mark.parametrize("result", [0, 0x704])
def test_add_remote_route_sends_the_datagram_of_tools(questions, result):
    tag = Tag.RESULT, result.to_bytes(4, "little")
    question, told, _ = add_remote_route(
        questions, lambda number: [answer(number, MILL, tag, service=ADD_ROUTE)]
    )
    assert told == result
    texts = {tag: decode_text(data) for tag, data in question.tags if tag != Tag.NET_ID}
    assert question.find(Tag.NET_ID) == OWN
    assert texts == {
        Tag.ROUTE_NAME: "left",
        Tag.USER: "Administrator",
        Tag.PASSWORD: "1",
        Tag.HOST: "127.0.0.1",
    }


def test_add_remote_route_ignores_answers_of_other_hosts(questions):
    def answers(number):
        yield answer(number, MILL, (Tag.RESULT, bytes(4)), service=ADD_ROUTE)

    _, told, _ = add_remote_route(questions, answers, sender="127.0.0.3")
    assert told is None


def test_add_remote_route_from_any_address_names_the_source_address(questions):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("0.0.0.0", 0))
        question, _, _ = add_remote_route(RouterRequests(sock, [OWN]), lambda number: [])
    assert decode_text(question.find(Tag.HOST)) == "127.0.0.1"


def test_network_of_address_is_its_broadcast_address(monkeypatch):
    assert network_of("127.9.8.7") == "127.255.255.255"
    assert network_of("0.0.0.0") == "255.255.255.255"
    monkeypatch.setattr(module, "broadcast_of", lambda address: "")
    assert network_of("127.9.8.7") == "255.255.255.255"


def test_scan_send_error_names_the_target(questions):
    with pytest.raises(EnvironmentalError, match=r"no request to 203\.0\.113\.1 from 127\.0\.0"):
        asyncio.run(questions.scan("203.0.113.1", wait_s=0))
