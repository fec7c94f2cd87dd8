"""One AMS/TCP connection, from the first packet to its end."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct

import pytest

from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Door
from eap.appliance.discards import Refusal
from eap.appliance.services import ams_connection
from eap.appliance.services.ams_connection import AmsClients, AmsConnection
from tests.support import aoe
from tests.support.routing import entrance, station, while_serving

pytestmark = pytest.mark.net

TARGET = "1.1.1.1.2.1"
NO_RETURN = 4 | 2


def ask(body: bytes = b"abc", number: int = 1, command: int = aoe.READ_STATE, **more) -> bytes:
    return prefixed(aoe.packet(more.pop("target", TARGET), command, body, invoke_id=number, **more))


def prefixed(packet: bytes, *, reserved: int = 0, length: int | None = None) -> bytes:
    return struct.pack("<HI", reserved, len(packet) if length is None else length) + packet


def talk(script, there=None, *, patience_s: float = 5) -> list[Refusal]:
    """Run ``script(reader, writer)`` on a connection that is being served."""
    there = there or station(TARGET)
    clients = AmsClients()
    there.add_door(Door("door", is_stream=True), clients)
    refused: list[Refusal] = []

    async def run():
        with socket.create_server(("127.0.0.1", 0)) as listener:
            ours = socket.create_connection(listener.getsockname())
            theirs, _ = listener.accept()
        served = await asyncio.open_connection(sock=theirs)
        client = AmsConnection(
            "client",
            *served,
            entrance(there),
            refused.append,
            patience_s=patience_s,
        )
        clients.add("client", client)
        stream = asyncio.ensure_future(client.serve())
        stream.add_done_callback(lambda _: served[1].close())
        reader, writer = await asyncio.open_connection(sock=ours)
        try:
            await asyncio.wait_for(script(reader, writer), 10)
        finally:
            writer.close()
            await asyncio.wait([stream], timeout=5)
            assert stream.done()
            served[1].transport.abort()
        error = stream.exception()
        assert error is None or isinstance(error, OSError)

    asyncio.run(while_serving(run(), there))
    clients.remove("client")
    assert clients.send("client", (b"",)) == "the connection is closed"
    return refused


async def hear(reader: asyncio.StreamReader) -> tuple[int, int, bytes]:
    """Return error, invoke id and data of the next packet."""
    reserved, length = struct.unpack("<HI", await reader.readexactly(6))
    packet = await reader.readexactly(length)
    flags, size, error, number = struct.unpack_from("<HIII", packet, 18)
    assert (reserved, flags & 1, size) == (0, 1, length - 32)
    assert packet[:6] == aoe.net_id(aoe.CLIENT)
    return error, number, packet[32:]


def test_requests_are_answered_in_their_order_however_they_are_cut():
    async def script(reader, writer):
        octets = ask(b"1", 1) + ask(b"2" * 3000, 2) + ask(b"3", 3)
        for begin, end in ((0, 1), (1, 7), (7, 60), (60, 900), (900, len(octets))):
            writer.write(octets[begin:end])
            await writer.drain()
            await asyncio.sleep(0.01)
        assert [(await hear(reader))[:2] for _ in range(3)] == [(0, 1), (0, 2), (0, 3)]

    assert talk(script) == []


def test_one_request_of_a_client_to_a_device_is_under_way():
    waiting = []

    async def slow(request) -> AmsAnswer:
        waiting.append(request.body)
        await asyncio.sleep(0.02)
        assert len(waiting) == 1
        return AmsAnswer(bytes(4) + waiting.pop())

    async def script(reader, writer):
        writer.write(b"".join(ask(bytes([n]), n) for n in range(5)))
        assert [(await hear(reader))[1] for _ in range(5)] == list(range(5))

    assert talk(script, station(TARGET, slow)) == []


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        (ask(target="9.9.9.9.1.1"), 7),
        (ask(port=1), 6),
        (ask(command=0x0902), 8),
    ],
)
def test_whoever_is_not_here_is_named(request_, error):
    async def script(reader, writer):
        writer.write(request_ + ask(b"x", 2))
        assert await hear(reader) == (error, 1, b"")
        assert (await hear(reader))[:2] == (0, 2)

    assert talk(script) == []


def test_wrong_lengths_are_answered_and_the_connection_goes_on():
    whole = aoe.packet(TARGET, 4, b"abc")
    huge = prefixed(aoe.packet(TARGET, 4, bytes(ams_connection.LONGEST_PACKET)))

    async def script(reader, writer):
        writer.write(prefixed(whole + b"surplus") + prefixed(whole[:-1]) + huge + ask(b"x", 9))
        assert [(await hear(reader))[0] for _ in range(3)] == [0xE, 0xE, 0xE]
        assert (await hear(reader))[:2] == (0, 9)

    assert talk(script) == [Refusal.AMS_LENGTH] * 3


@pytest.mark.parametrize("octets", [b"GET / HTTP/1.1\r\n", prefixed(b""), prefixed(b"", length=31)])
def test_what_is_no_ams_packet_ends_the_connection(octets):
    async def script(reader, writer):
        writer.write(ask() + octets)
        assert (await hear(reader))[0] == 0
        assert await reader.read() == b""

    assert talk(script) == [Refusal.AMS_TYPE]


def test_answers_that_nobody_asked_for_are_counted():
    async def script(reader, writer):
        writer.write(ask(flags=5) + ask(b"x", 2))
        assert (await hear(reader))[1] == 2

    assert talk(script) == [Refusal.AMS_UNASKED]


def test_who_wants_no_answer_gets_none():
    async def script(reader, writer):
        writer.write(ask(flags=NO_RETURN) + ask(b"x", 2))
        assert (await hear(reader))[1] == 2

    assert talk(script) == []


def test_packet_that_is_not_finished_ends_the_connection():
    async def script(reader, writer):
        for octet in ask()[:30]:
            writer.write(bytes([octet]))
            await asyncio.sleep(0.01)

    assert talk(script, patience_s=0.1) == [Refusal.AMS_SLOW]


def test_silence_between_packets_may_last():
    async def script(reader, writer):
        for number in (1, 2):
            writer.write(ask(b"x", number))
            assert (await hear(reader))[1] == number
            await asyncio.sleep(0.2)

    assert talk(script, patience_s=0.05) == []


def test_client_that_takes_nothing_is_disconnected():
    async def script(reader, writer):
        reader._limit = 1  # so that it stops reading
        for _ in range(2000):
            writer.write(ask(bytes(16 << 10)))
            try:
                await asyncio.wait_for(writer.drain(), 0.5)
            except TimeoutError:
                return
        raise AssertionError("everything was taken")

    assert talk(script, patience_s=0.1) == [Refusal.AMS_SLOW]


def test_client_that_breaks_off_costs_nothing():
    async def script(reader, writer):
        writer.write(ask() + ask()[:20])
        await writer.drain()
        writer.transport.abort()

    assert talk(script) == []


def test_client_that_has_vanished_is_not_slow():
    """The kernel says so after some probes, with an error that is a TimeoutError too."""
    refused = []

    async def run():
        reader = asyncio.StreamReader()
        reader.set_exception(TimeoutError(errno.ETIMEDOUT, "Connection timed out"))
        _, writer = await asyncio.open_connection(sock=ours)
        client = AmsConnection("client", reader, writer, entrance(), refused.append)
        with pytest.raises(OSError, match="timed out"):
            await client.serve()
        writer.transport.abort()

    ours, theirs = socket.socketpair()
    with theirs:
        asyncio.run(run())
    assert refused == []
