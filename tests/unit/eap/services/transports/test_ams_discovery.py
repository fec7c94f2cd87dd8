"""UDP 48899: answers to requests for server info and routes."""

from __future__ import annotations

import asyncio
import socket
from importlib.metadata import version

import pytest

from eap.codec.ads import AdsError
from eap.codec.amsdiscovery import (
    DiscoveryHeader,
    Tag,
    decode_discovery,
    encode_discovery,
    encode_version,
)
from eap.ids import NetId
from eap.runtime.drop_counters import DropReason
from eap.services.routing.remote_routers import RouterRequests
from eap.services.transports.ams_discovery import AmsDiscovery, RouterName
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


class Admin:
    """Stands for who decides on routes."""

    def __init__(self, result=AdsError.NONE):
        self.result = result
        self.requested = []

    async def handle(self, question, sender, *, is_this_host):
        self.requested.append((question.find(Tag.ROUTE_NAME), sender, is_this_host))
        return self.result


def discovery(sock, *routers, route_admin=None, refused=None):
    refuse = [].append if refused is None else refused.append
    questions = RouterRequests(sock, [LEFT.net_id])
    return AmsDiscovery(sock, routers or [LEFT], route_admin or Admin(), questions, refuse)


def test_every_router_of_the_address_names_itself(sock):
    answers = asyncio.run(discovery(sock, LEFT, RIGHT).answers_to(SERVER_INFO, "10.0.0.5"))
    release = encode_version(version("eap-appliance")).hex()
    assert answers[0].hex() == (
        "03661471" + "00000000" + "01000080" + "010101010101" + "1027" + "02000000"
        "0500" + "0500" + "6c65667400" + "0300" + "0400" + release
    )  # fmt: skip
    assert [decode_discovery(each).header.net_id for each in answers] == [
        LEFT.net_id,
        RIGHT.net_id,
    ]


def test_answer_has_the_invoke_id_of_the_request(sock):
    header = DiscoveryHeader(0, 0xDEADBEEF, 1, NOTHING, 0)
    (answer,) = asyncio.run(discovery(sock).answers_to(encode_discovery(header), "10.0.0.5"))
    assert decode_discovery(answer).header.invoke_id == 0xDEADBEEF


@pytest.mark.parametrize(
    ("sender", "is_this_host"), [("127.0.0.1", True), ("127.9.9.9", True), ("10.0.0.5", False)]
)
def test_add_route_request_is_answered_once(sock, sender, is_this_host):
    admin = Admin(AdsError.ACCESS)
    (answer,) = asyncio.run(
        discovery(sock, LEFT, RIGHT, route_admin=admin).answers_to(ADD_ROUTE, sender)
    )
    read = decode_discovery(answer)
    assert read.header.service == 0x8000_0006
    assert read.find(Tag.RESULT) == b"\4\7\0\0"
    assert admin.requested == [(b"myroute\0", sender, is_this_host)]


def test_too_many_routes_are_not_answered(sock):
    assert (
        asyncio.run(discovery(sock, route_admin=Admin(None)).answers_to(ADD_ROUTE, "10.0.0.5"))
        == []
    )


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
def test_invalid_datagram_gets_no_answer(sock, data):
    assert asyncio.run(discovery(sock).answers_to(data, "10.0.0.5")) == []


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
    assert refused == [DropReason.AMS_DISCOVERY] * 2


def test_broadcast_is_answered_from_the_unicast_address(sock):
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


def test_answers_to_own_requests_are_not_handled_as_requests(sock):
    refused = []

    async def run():
        loop = asyncio.get_running_loop()
        questions = RouterRequests(sock, [LEFT.net_id])
        AmsDiscovery(sock, [LEFT], Admin(), questions, refused.append).watch()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.2", 0))
            other.setblocking(False)
            scan = asyncio.create_task(
                questions.scan("127.0.0.2", wait_s=0.2, port=other.getsockname()[1])
            )
            data = await asyncio.wait_for(loop.sock_recv(other, 100), 5)
            number = decode_discovery(data).header.invoke_id
            header = DiscoveryHeader(0, number, 0x8000_0001, NetId(b"222211"), 10_000)
            other.sendto(encode_discovery(header), sock.getsockname())
            other.sendto(b"?", sock.getsockname())
            found = await scan
        loop.remove_reader(sock.fileno())
        return found

    assert len(asyncio.run(run())) == 1
    assert refused == [DropReason.AMS_DISCOVERY]
