"""UDP 48899: which routers are there."""

from __future__ import annotations

import asyncio
import logging
import socket

import pytest

from eap.appliance.discards import Refusal
from eap.appliance.services.ams_discovery import AmsDiscovery, RouterName
from eap.codec.amsdiscovery import DiscoveryHeader, Tag, decode_discovery, encode_discovery
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


def test_every_router_of_the_address_names_itself(sock):
    answers = AmsDiscovery(sock, [LEFT, RIGHT], [].append).answers_to(SERVER_INFO)
    assert answers[0].hex() == (
        "03661471" + "00000000" + "01000080" + "010101010101" + "1027" + "01000000"
        "0500" + "0500" + "6c65667400"
    )  # fmt: skip
    assert [decode_discovery(each).header.net_id for each in answers] == [
        LEFT.net_id,
        RIGHT.net_id,
    ]


def test_the_number_of_the_question_comes_back(sock):
    header = DiscoveryHeader(0, 0xDEADBEEF, 1, NOTHING, 0)
    (answer,) = AmsDiscovery(sock, [LEFT], [].append).answers_to(encode_discovery(header))
    assert decode_discovery(answer).header.invoke_id == 0xDEADBEEF


def test_routes_are_refused_and_that_is_said_once(sock, caplog):
    discovery = AmsDiscovery(sock, [LEFT, RIGHT], [].append)
    with caplog.at_level(logging.WARNING):
        (answer,) = discovery.answers_to(ADD_ROUTE)
        discovery.answers_to(ADD_ROUTE)
    read = decode_discovery(answer)
    assert read.header.service == 0x8000_0006
    assert read.find(Tag.RESULT) == b"\1\7\0\0"
    (line,) = caplog.messages
    assert line == "route 'myroute' is not added: who asks is answered without"


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
    assert AmsDiscovery(sock, [LEFT], [].append).answers_to(data) == []


def test_datagrams_are_answered_to_their_senders(sock):
    refused = []

    async def run():
        AmsDiscovery(sock, [LEFT], refused.append).watch()
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
