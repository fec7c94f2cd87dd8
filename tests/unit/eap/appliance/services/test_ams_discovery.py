"""UDP 48899: which routers are there."""

from __future__ import annotations

import asyncio
import socket
from importlib.metadata import version

import pytest

from eap.appliance.discards import Refusal
from eap.appliance.services import ams_discovery as module
from eap.appliance.services.ams_discovery import AmsDiscovery, RouterName, network_of
from eap.appliance.services.neighbours import Neighbour
from eap.codec.ads import AdsError
from eap.codec.amsdiscovery import (
    DiscoveryHeader,
    Tag,
    decode_discovery,
    encode_discovery,
    encode_version,
)
from eap.errors import EnvironmentalError
from eap.ids import NetId
from tests.support.vectors import load

pytestmark = pytest.mark.net

LEFT = RouterName("left", NetId.parse("1.1.1.1.1.1"))
RIGHT = RouterName("right", NetId.parse("1.1.1.2.1.1"))
ADD_ROUTE, SERVER_INFO = (vector.octets for vector in load("ams_discovery"))
NOTHING = NetId(bytes(6))


@pytest.fixture
def sock():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound


class Desk:
    """Stands for who decides on routes."""

    def __init__(self, result=AdsError.NONE):
        self.result = result
        self.asked = []

    def take(self, question, sender, *, is_this_host):
        self.asked.append((question.find(Tag.ROUTE_NAME), sender, is_this_host))
        return self.result


def discovery(sock, *routers, desk=None, refused=None):
    refuse = [].append if refused is None else refused.append
    return AmsDiscovery(sock, routers or [LEFT], desk or Desk(), refuse)


def test_every_router_of_the_address_names_itself(sock):
    answers = discovery(sock, LEFT, RIGHT).answers_to(SERVER_INFO, "10.0.0.5")
    release = encode_version(version("eap-appliance")).hex()
    assert answers[0].hex() == (
        "03661471" + "00000000" + "01000080" + "010101010101" + "1027" + "02000000"
        "0500" + "0500" + "6c65667400" + "0300" + "0400" + release
    )  # fmt: skip
    assert [decode_discovery(each).header.net_id for each in answers] == [
        LEFT.net_id,
        RIGHT.net_id,
    ]


def test_the_number_of_the_question_comes_back(sock):
    header = DiscoveryHeader(0, 0xDEADBEEF, 1, NOTHING, 0)
    (answer,) = discovery(sock).answers_to(encode_discovery(header), "10.0.0.5")
    assert decode_discovery(answer).header.invoke_id == 0xDEADBEEF


@pytest.mark.parametrize(
    ("sender", "is_this_host"), [("127.0.0.1", True), ("127.9.9.9", True), ("10.0.0.5", False)]
)
def test_a_route_is_decided_on_and_answered_once(sock, sender, is_this_host):
    desk = Desk(AdsError.ACCESS)
    (answer,) = discovery(sock, LEFT, RIGHT, desk=desk).answers_to(ADD_ROUTE, sender)
    read = decode_discovery(answer)
    assert read.header.service == 0x8000_0006
    assert read.find(Tag.RESULT) == b"\4\7\0\0"
    assert desk.asked == [(b"myroute\0", sender, is_this_host)]


def test_too_many_routes_are_not_answered(sock):
    assert discovery(sock, desk=Desk(None)).answers_to(ADD_ROUTE, "10.0.0.5") == []


@pytest.mark.parametrize(
    "data",
    [
        b"",
        SERVER_INFO[:-1],
        b"x" * 24,
        encode_discovery(DiscoveryHeader(0, 0, 2, NOTHING, 0)),
        encode_discovery(DiscoveryHeader(0, 0, 0x8000_0001, NOTHING, 0)),
    ],
)
def test_nothing_is_said_to_what_is_no_question(sock, data):
    assert discovery(sock).answers_to(data, "10.0.0.5") == []


def test_datagrams_are_answered_to_their_senders(sock):
    refused = []

    async def run():
        discovery(sock, refused=refused).watch()
        loop = asyncio.get_running_loop()
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone,
        ):
            gone.bind(("127.0.0.1", 0))
            gone.sendto(SERVER_INFO, sock.getsockname())
            gone.close()
            for each in (one, other):
                each.setblocking(False)
                each.bind(("127.0.0.1", 0))
                for data in (b"?", SERVER_INFO):
                    each.sendto(data, sock.getsockname())
            for each in (one, other):
                data = await asyncio.wait_for(loop.sock_recv(each, 100), 5)
                assert decode_discovery(data).header.net_id == LEFT.net_id
        loop.remove_reader(sock.fileno())

    asyncio.run(run())
    assert refused == [Refusal.AMS_DISCOVERY] * 2


def test_what_comes_to_a_network_is_answered_from_the_address(sock):
    async def run():
        loop = asyncio.get_running_loop()
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as many,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        ):
            many.bind(("127.0.0.2", 0))
            discovery(sock).watch(many)
            client.setblocking(False)
            client.sendto(SERVER_INFO, many.getsockname())
            data, sender = await asyncio.wait_for(loop.sock_recvfrom(client, 100), 5)
            loop.remove_reader(many.fileno())
        assert decode_discovery(data).header.net_id == LEFT.net_id
        assert sender == sock.getsockname()

    asyncio.run(run())


def answer(number, net_id, *tags, service=0x8000_0001):
    header = DiscoveryHeader(0, number, service, net_id, 10_000)
    return encode_discovery(header, tags)


class Scan:
    """A question to one other socket, which sends what *answers* makes of its number."""

    def __init__(self, sock, answers):
        self.sock = sock
        self.answers = answers
        self.refused = []
        self.question = None

    async def run(self):
        found = discovery(self.sock, refused=self.refused)
        found.watch()
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.2", 0))
            other.setblocking(False)
            scan = asyncio.create_task(
                found.scan("127.0.0.2", wait_s=0.2, port=other.getsockname()[1])
            )
            data = await asyncio.wait_for(loop.sock_recv(other, 100), 5)
            self.question = decode_discovery(data).header
            for each in self.answers(self.question.invoke_id):
                other.sendto(each, self.sock.getsockname())
            neighbours = await scan
        loop.remove_reader(self.sock.fileno())
        return neighbours


def test_who_answers_a_question_is_found(sock):
    mill = NetId.parse("2.2.2.2.1.1")

    def answers(number):
        version = (Tag.VERSION, b"\3\1\xb8\x0f")
        yield answer(number, mill, (Tag.HOST, b"mi\x1bll\0"), version)
        yield answer(number, mill, (Tag.HOST, b"again\0"))
        yield answer(number, LEFT.net_id)  # itself
        yield answer(number, NOTHING)
        yield answer(number, NetId.parse("3.3.3.3.1.1"))

    scan = Scan(sock, answers)
    assert asyncio.run(scan.run()) == [
        Neighbour("mill", mill, "127.0.0.2", "3.1.4024"),
        Neighbour("", NetId.parse("3.3.3.3.1.1"), "127.0.0.2", ""),
    ]
    assert scan.question.service == 1
    assert scan.question.net_id == LEFT.net_id
    assert scan.refused == []


def test_answers_that_nobody_asked_for_are_not_taken(sock):
    mill = NetId.parse("2.2.2.2.1.1")

    def answers(number):
        yield answer(number + 1, mill)
        yield answer(number, mill, service=0x8000_0006)
        yield b"?"

    scan = Scan(sock, answers)
    assert asyncio.run(scan.run()) == []
    assert scan.refused == [Refusal.AMS_DISCOVERY] * 3


def test_a_network_is_asked_at_its_broadcast_address(monkeypatch):
    assert network_of("127.9.8.7") == "127.255.255.255"
    assert network_of("0.0.0.0") == "255.255.255.255"
    monkeypatch.setattr(module, "broadcast_of", lambda address: "")
    assert network_of("127.9.8.7") == "255.255.255.255"


def test_a_network_that_cannot_be_asked_says_so(sock):
    with pytest.raises(EnvironmentalError, match=r"203\.0\.113\.1 cannot be asked from 127\.0\.0"):
        asyncio.run(discovery(sock).scan("203.0.113.1", wait_s=0))
