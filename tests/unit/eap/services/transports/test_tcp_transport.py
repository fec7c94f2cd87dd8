"""Connections sorted by their first frame."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Awaitable, Callable

import pytest

from eap.ams.transport_table import Transport
from eap.codec.ethercat import EtherCatHeader
from eap.net import limits
from eap.net.limits import OWN_HOST, Activity, ListenerLimits
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName
from eap.runtime.passing import receive_passed
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from eap.services.transports import accepting
from eap.services.transports import mailbox_stream as tcp_door
from eap.services.transports.accepting import Listeners
from eap.services.transports.mailbox_stream import MailboxStreams, StreamConnection, TcpTransport
from tests.support import aoe
from tests.support.eventually import eventually, settle
from tests.support.routing import demultiplexer, station

pytestmark = pytest.mark.net

OWNERS = (PortName("a", "eap0"),)
TARGET = "1.1.1.1.2.1"


def frame(kind: int) -> bytes:
    return EtherCatHeader(4, 0, kind).encode() + bytes(4)


class Scene:
    """A transport, the engine's end of its link, and what it refused."""

    def __init__(self, listener, engine, refused, listeners) -> None:
        self.listeners = listeners
        self.address = listener.getsockname()
        self.engine = engine
        self.refused = refused

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection(*self.address)

    async def send(self, data: bytes) -> bytes:
        """Return what comes back until the transport closes."""
        reader, writer = await self.connect()
        writer.write(data)
        try:
            return await asyncio.wait_for(reader.read(), 5)
        except ConnectionResetError:
            return b""
        finally:
            writer.close()


def play(
    script: Callable[[Scene], Awaitable[None]], takers=OWNERS, patience_s: float = 5
) -> list[DropReason]:
    refused: list[DropReason] = []

    async def run():
        services, engine = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with services, engine, socket.create_server(("127.0.0.1", 0)) as listener:
            there = station(TARGET)
            streams = MailboxStreams(
                demultiplexer(there), GatewayTransport(GatewayTable(), {}), refused.append
            )
            there.add_transport(Transport("link", is_stream=True), streams)
            listeners = Listeners(int(patience_s * 1e9))
            transport = TcpTransport(listener, takers, services, refused.append, streams, listeners)
            serving = [
                asyncio.ensure_future(each.serve()) for each in (transport, there, listeners)
            ]
            await script(Scene(listener, engine, refused, listeners))
            for task in serving:
                task.cancel()
            await asyncio.wait(serving)

    asyncio.run(run())
    return refused


def test_type_4_goes_to_the_engine_with_its_first_frame():
    async def script(scene):
        _, writer = await scene.connect()
        data = frame(4)
        writer.write(data[:1])
        await writer.drain()
        await settle()
        writer.write(data[1:])
        taken = []
        await eventually(lambda: taken.append(receive_passed(scene.engine)) or taken[-1])
        connection, passed = taken[-1]
        with connection:
            assert passed.owners == OWNERS
            assert passed.host == OWN_HOST
            assert connection.recv(100) == data
        await eventually(lambda: scene.listeners.stats()[0].open == 0)
        writer.close()

    assert play(script) == []


@pytest.mark.parametrize(
    ("kind", "takers", "reason"),
    [
        (5, OWNERS, DropReason.TCP_TYPE),
        (4, (), DropReason.TCP_OFF),
        (7, OWNERS, DropReason.WRONG_TYPE),
    ],
)
def test_others_are_closed_with_a_reason(kind, takers, reason):
    async def script(scene):
        assert await scene.send(frame(kind)) == b""

    assert play(script, takers) == [reason]


def test_type_5_is_answered_by_services():
    async def script(scene):
        reader, writer = await scene.connect()
        writer.write(aoe.frame(aoe.packet(TARGET, 4, b"abc")))
        writer.write_eof()
        back = await asyncio.wait_for(reader.read(), 5)
        assert aoe.answer(back).data == b"\4cba"
        writer.close()

    assert play(script) == []


def test_a_fault_ends_one_connection_only(monkeypatch, caplog):
    async def fail(streams, connection, sock):
        raise RuntimeError("a fault")

    async def script(scene):
        for _ in range(2):
            assert await scene.send(frame(5)) == b""

    monkeypatch.setattr(MailboxStreams, "serve", fail)
    assert play(script) == []
    assert ["a fault" in record.exc_text for record in caplog.records] == [True, True]


def test_connection_with_a_frame_goes_before_silent_ones(monkeypatch):
    monkeypatch.setattr(tcp_door, "LIMITS", ListenerLimits(total=2, reserved=0))
    monkeypatch.setattr(limits, "FRESH_NS", 0)
    monkeypatch.setattr(accepting, "host_of", lambda peer, own: "10.0.0.1")
    question = aoe.frame(aoe.packet(TARGET, 4, b""))

    async def script(scene):
        reader, writer = await scene.connect()
        writer.write(question)
        await asyncio.wait_for(reader.readexactly(8), 5)
        silent, other = await scene.connect()
        late_reader, late = await scene.connect()
        late.write(question)
        await asyncio.wait_for(late_reader.readexactly(8), 5)
        assert await silent.read() == b""
        assert await scene.send(question) == b""  # both are in use
        for each in (writer, other, late):
            each.close()

    assert play(script) == [DropReason.TCP_FULL]


def test_subscribed_connection_is_known_as_such():
    connection = StreamConnection(OWN_HOST)
    seen = [connection.activity]
    connection.note_frame()
    seen.append(connection.activity)
    connection.waiting = lambda: 1
    seen.append(connection.activity)
    granted = bytes(4) + struct.pack("<I", 7)
    connection.subscriptions.note_answer(aoe.packet("1.1.1.1.2.1", 6, granted, flags=5))
    seen.append(connection.activity)
    assert seen == list(Activity)
    connection.subscriptions.note_answer(aoe.packet("1.1.1.1.2.1", 7, bytes(4), flags=5))
    assert connection.activity is Activity.BUSY, "the subscription has ended"


@pytest.mark.parametrize("octets", [b"\x04", aoe.frame(aoe.packet(TARGET, 4, b""))[:9]])
def test_frame_that_stays_unfinished_ends_the_connection(octets):
    async def script(scene):
        assert await scene.send(octets) == b""

    assert play(script, patience_s=0.05) == [DropReason.TCP_SLOW]


def test_silent_connection_is_kept():
    async def script(scene):
        reader, writer = await scene.connect()
        await scene.send(b"\x04")  # which takes the time of an unfinished frame
        writer.write(aoe.frame(aoe.packet(TARGET, 4, b"")))
        assert await asyncio.wait_for(reader.readexactly(8), 5)
        writer.close()

    assert play(script, patience_s=0.05) == [DropReason.TCP_SLOW]


def test_connection_closed_before_a_frame_is_not_counted():
    async def script(scene):
        for _ in range(3):
            _, writer = await scene.connect()
            writer.close()
            await writer.wait_closed()
        assert await scene.send(frame(7)) == b""

    assert play(script) == [DropReason.WRONG_TYPE]


def test_a_gone_engine_link_closes_the_connection():
    async def script(scene):
        scene.engine.close()
        assert await scene.send(frame(4)) == b""

    assert play(script) == [DropReason.ENGINE_BUSY]
