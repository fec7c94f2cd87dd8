"""Frames of type 5 over a TCP connection."""

from __future__ import annotations

import asyncio
import socket

import pytest

from eap.ams.routes import Route
from eap.ams.transport_table import Transport
from eap.codec.ams import AmsAnswer
from eap.ids import Endpoint, NetId
from eap.net.limits import OWN_HOST
from eap.runtime.drop_counters import DropReason
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from eap.services.transports import mailbox_stream
from eap.services.transports.mailbox_stream import MailboxStreams, StreamConnection
from tests.support import aoe
from tests.support.eventually import settle
from tests.support.routing import demultiplexer, station, while_serving

pytestmark = pytest.mark.net

TARGET = "1.1.1.1.2.1"


def ask(body: bytes = b"abc", number: int = 1) -> bytes:
    return aoe.frame(aoe.packet(TARGET, 4, body, invoke_id=number))


def talk(script, there=None) -> list[DropReason]:
    """Run ``script(reader, writer)`` on a connection that is being served."""
    there = there or station(TARGET)
    refused: list[DropReason] = []
    streams = MailboxStreams(
        demultiplexer(there), GatewayTransport(GatewayTable(), {}), refused.append
    )
    there.add_transport(Transport("link", 2000, is_stream=True), streams)

    async def run():
        ours, theirs = socket.socketpair()
        stream = asyncio.ensure_future(streams.serve(StreamConnection(OWN_HOST), theirs))
        reader, writer = await asyncio.open_connection(sock=ours)
        try:
            await script(reader, writer)
        finally:
            writer.close()
            await asyncio.wait_for(stream, 5)

    asyncio.run(while_serving(run(), there))
    assert streams.send("x#0", (b"",)) == "the connection is closed"
    return refused


async def hear(reader: asyncio.StreamReader) -> aoe.Answer:
    head = await asyncio.wait_for(reader.readexactly(2), 5)
    return aoe.answer(head + await reader.readexactly((head[0] | head[1] << 8) & 0x7FF))


def test_frames_are_cut_by_their_length():
    async def script(reader, writer):
        octets = ask(b"1", 1) + ask(b"2" * 1500, 2) + ask(b"3", 3)
        for at in (0, 1, 5, 60, 700):
            following = {0: 1, 1: 5, 5: 60, 60: 700, 700: len(octets)}[at]
            writer.write(octets[at:following])
            await writer.drain()
            await settle()
        assert [(await hear(reader)).invoke_id for _ in range(3)] == [1, 2, 3]

    assert talk(script) == []


def test_half_closed_stream_is_still_answered():
    async def slow(request) -> AmsAnswer:
        await settle()
        return AmsAnswer(bytes(4) + request.body)

    async def script(reader, writer):
        writer.write(ask(b"late"))
        writer.write_eof()
        assert (await hear(reader)).data == b"late"
        assert await reader.read() == b""

    assert talk(script, station(TARGET, slow)) == []


@pytest.mark.parametrize("octets", [b"\x04\x40" + bytes(4), b"\x05\x50" + bytes(5)])
def test_invalid_frame_closes_the_stream(octets):
    async def script(reader, writer):
        writer.write(ask() + octets)
        assert (await hear(reader)).error == 0
        assert await asyncio.wait_for(reader.read(), 5) == b""

    assert talk(script) == [DropReason.TCP_TYPE]


def test_dropped_frame_is_counted_and_the_stream_stays_open():
    async def script(reader, writer):
        writer.write(aoe.frame(b"x" * 10, kind=3) + ask())
        assert (await hear(reader)).error == 0

    assert talk(script) == [DropReason.MAILBOX]


def test_client_that_breaks_off_costs_nothing():
    async def script(reader, writer):
        writer.write(ask() + ask()[:20])
        await writer.drain()
        writer.transport.abort()

    assert talk(script) == []


def test_stream_is_closed_when_client_stops_reading(monkeypatch):
    monkeypatch.setattr(mailbox_stream, "SLOW_READER_S", 0.05)

    async def script(reader, writer):
        for _ in range(2000):
            writer.write(ask(b"x" * 1900))
            try:
                await asyncio.wait_for(writer.drain(), 1)
            except OSError:
                return
        raise AssertionError("still connected")

    talk(script)


def test_hop_sends_requests_on_the_same_connection():
    here, there = station("2.2.2.2.2.1"), station(TARGET)
    refused: list[DropReason] = []
    near, far = (
        MailboxStreams(demultiplexer(each), GatewayTransport(GatewayTable(), {}), refused.append)
        for each in (here, there)
    )
    here.add_transport(Transport("link", 2000, is_stream=True), near)
    there.add_transport(Transport("link", 2000, is_stream=True), far)

    async def run():
        with socket.create_server(("127.0.0.1", 0)) as listener:
            listener.setblocking(False)
            hop = f"127.0.0.1:{listener.getsockname()[1]}"
            here.add_route(
                Route(NetId.parse(TARGET), "there", Endpoint("link", hop), is_probed=False)
            )
            asking = asyncio.ensure_future(
                here.request(NetId.parse(TARGET), 0xFFFF, 4, timeout_s=5)
            )
            connection, _ = await asyncio.get_running_loop().sock_accept(listener)
            stream = asyncio.ensure_future(far.serve(StreamConnection(OWN_HOST), connection))
            answer = await asking
            (name,) = there.record.connections.snapshot()
            there.add_route(Route(NetId.parse("2.2.2.2.2.1"), "here", name, is_probed=False))
            back = await there.request(NetId.parse("2.2.2.2.2.1"), 0xFFFF, 4, timeout_s=5)
            await near.close()
            await stream
            return answer, back

    answers = asyncio.run(while_serving(run(), here, there))
    assert [each.data for each in answers] == [b"\0\0\0\0\4"] * 2
    assert refused == []
