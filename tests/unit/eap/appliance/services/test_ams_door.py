"""The AMS/TCP listener of an address."""

from __future__ import annotations

import asyncio
import socket
import struct

import pytest

from eap.aoe.way import Door
from eap.appliance.discards import Refusal
from eap.appliance.services import ams_door
from eap.appliance.services.ams_connection import AmsClients
from eap.appliance.services.ams_door import AmsDoor
from tests.support import aoe
from tests.support.routing import echo, entrance, station

pytestmark = pytest.mark.net

TARGETS = ("1.1.1.1.2.1", "1.1.1.2.2.1")


def question(body: bytes, target: str = TARGETS[0]) -> bytes:
    packet = aoe.packet(target, aoe.READ_STATE, body)
    return struct.pack("<HI", 0, len(packet)) + packet


async def hear(reader) -> bytes:
    """Return the data of the next answer, which is echoed backwards behind its command."""
    _, length = struct.unpack("<HI", await reader.readexactly(6))
    return (await reader.readexactly(length))[37:][::-1]


def play(script, *, patience_s: float = 5, reply=echo) -> list[Refusal]:
    """Run ``script(connect, listener)`` while a door serves two stations."""
    refused: list[Refusal] = []

    async def run():
        with socket.create_server(("127.0.0.1", 0)) as listener:
            there = [station(target, reply) for target in TARGETS]
            clients = AmsClients()
            for each in there:
                each.add_door(Door("door", is_stream=True), clients)
            door = AmsDoor(
                listener, entrance(*there), clients, refused.append, patience_s=patience_s
            )
            serving = [asyncio.ensure_future(each.serve()) for each in (door, *there)]

            async def connect():
                return await asyncio.open_connection(*listener.getsockname())

            await asyncio.wait_for(script(connect, listener), 10)
            for task in serving:
                task.cancel()
            await asyncio.wait(serving)
            assert all(task.cancelled() for task in serving)

    asyncio.run(run())
    return refused


def test_each_answer_goes_back_on_the_connection_of_its_question():
    """All clients look alike: the same NetID, port and numbers of requests."""

    async def client(connect, name):
        reader, writer = await connect()
        for number in range(50):
            body = f"{name} {number}".encode()
            writer.write(question(body, TARGETS[number % 2]))
            assert await hear(reader) == body
        writer.close()

    async def script(connect, listener):
        await asyncio.gather(*(client(connect, name) for name in range(20)))

    assert play(script) == []


def test_who_sends_ahead_lets_others_in_between():
    served = []

    def note(request):
        served.append(request.body)
        return echo(request)

    async def script(connect, listener):
        greedy, writer = await connect()
        reader, other = await connect()
        writer.write(question(b"greedy") * 500)
        other.write(question(b"other"))
        assert await hear(reader) == b"other"
        for _ in range(500):
            assert await hear(greedy) == b"greedy"
        writer.close()
        other.close()

    assert play(script, reply=note) == []
    assert len(served) == 501
    assert served.index(b"other") < 250


def test_client_that_dies_leaves_the_others_alone():
    async def script(connect, listener):
        reader, writer = await connect()
        for _ in range(20):
            _, dying = await connect()
            dying.write(question(b"x") * 3 + question(b"y")[:20])
            dying.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
            )
            dying.transport.abort()
            writer.write(question(b"alive"))
            assert await hear(reader) == b"alive"
        writer.close()

    assert play(script) == []


def test_there_is_a_limit_and_room_again_when_somebody_leaves(monkeypatch):
    monkeypatch.setattr(ams_door, "MAX_CONNECTIONS", 2)

    async def script(connect, listener):
        first, second = await connect(), await connect()
        third, writer = await connect()
        assert await third.read() == b""
        writer.close()
        first[1].close()
        await first[1].wait_closed()
        await asyncio.sleep(0.05)
        reader, writer = await connect()
        for each, (to, back) in enumerate(((writer, reader), second[::-1])):
            to.write(question(bytes([each])))
            assert await hear(back) == bytes([each])
            to.close()

    assert play(script) == [Refusal.AMS_FULL]


def test_client_that_breaks_the_rules_is_disconnected():
    async def script(connect, listener):
        for octets in (b"\1\0" + bytes(4), question(b"x")[:10]):
            reader, writer = await connect()
            writer.write(octets)
            assert await reader.read() == b""
            writer.close()

    assert play(script, patience_s=0.1) == [Refusal.AMS_TYPE, Refusal.AMS_SLOW]


def test_who_has_only_closed_its_sending_side_is_still_answered():
    async def script(connect, listener):
        reader, writer = await connect()
        writer.write(question(b"last"))
        writer.write_eof()
        assert await hear(reader) == b"last"
        assert await reader.read() == b""
        writer.close()

    assert play(script) == []


def test_dead_peers_are_looked_for(monkeypatch):
    seen = []
    original = ams_door._set_options

    def note(connection):
        original(connection)
        seen.append(
            (
                connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE),
                connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE)
                + 3 * connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL),
            )
        )

    monkeypatch.setattr(ams_door, "_set_options", note)

    async def script(connect, listener):
        reader, writer = await connect()
        writer.write(question(b"x"))
        await hear(reader)
        writer.close()

    play(script)
    assert seen == [(1, 60)]
