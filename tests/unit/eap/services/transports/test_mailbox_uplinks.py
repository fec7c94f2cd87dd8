"""Connections of a stream transport to other stations."""

from __future__ import annotations

import asyncio
import socket

import pytest

from eap.services.transports import mailbox_stream
from eap.services.transports.mailbox_stream import StreamUplinks
from tests.support.eventually import eventually

pytestmark = pytest.mark.net


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(mailbox_stream, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(mailbox_stream, "LONGEST_PAUSE_S", 0.02)
    monkeypatch.setattr(mailbox_stream, "CONNECT_S", 0.5)


class PacketRouter:
    """Notes what is said of hops."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.wanted = True
        self.awaited = True

    def hop_down(self, address, text):
        self.said.append(text)

    def hop_up(self, address):
        self.said.append("up")

    def has_route_to(self, address):
        return self.wanted

    def is_awaited(self, address):
        return self.awaited


class Scene:
    """StreamUplinks, and the other side."""

    def __init__(self) -> None:
        self.hops = PacketRouter()
        self.heard: list[bytes] = []
        self.connections: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []
        self.uplinks = StreamUplinks(self.hops, self._serve, "127.0.0.1")
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"

    async def _serve(self, reader, writer, name):
        assert name == self.address
        while data := await reader.read(100):
            self.heard.append(data)

    async def accept(self):
        """Return reader and writer of the next connection."""
        loop = asyncio.get_running_loop()
        self.listener.setblocking(False)
        connection, _ = await loop.sock_accept(self.listener)
        self.connections.append(await asyncio.open_connection(sock=connection))
        return self.connections[-1]

    async def said(self, *texts):
        await eventually(lambda: self.hops.said == list(texts))
        self.hops.said.clear()


def play(script) -> Scene:
    """Run ``script(scene)``."""

    async def run():
        scene = Scene()
        with scene.listener:
            try:
                await asyncio.wait_for(script(scene), 10)
            finally:
                await scene.uplinks.close()
                for _, writer in scene.connections:
                    writer.transport.abort()
                await asyncio.sleep(0)
        return scene

    return asyncio.run(run())


def test_uplink_send_opens_a_connection_and_keeps_the_data():
    async def script(scene):
        assert scene.uplinks.send(scene.address, b"one,") is None
        assert scene.uplinks.send(scene.address, b"two,") is None
        reader, writer = await scene.accept()
        assert await reader.readexactly(8) == b"one,two,"
        assert scene.uplinks.send(scene.address, b"three") is None
        assert await reader.readexactly(5) == b"three"
        writer.write(b"back")
        await scene.said("up")
        await eventually(lambda: scene.heard)

    assert play(script).heard == [b"back"]


def test_hop_that_refuses_is_down_until_it_accepts():
    async def script(scene):
        address = scene.listener.getsockname()
        scene.listener.close()
        scene.uplinks.send(scene.address, b"lost")
        await eventually(lambda: len(scene.hops.said) >= 3)
        assert set(scene.hops.said) == {"no connection: Connect call failed " + str(address)}
        scene.listener = socket.create_server(address)
        with scene.listener:
            reader, _ = await scene.accept()
            await eventually(lambda: scene.hops.said[-1] == "up")
            scene.uplinks.send(scene.address, b"next")
            assert await reader.readexactly(4) == b"next"

    play(script)


def test_connection_that_breaks_is_made_again_at_once():
    async def script(scene):
        scene.uplinks.send(scene.address, b"x")
        _, writer = await scene.accept()
        await scene.said("up")
        writer.close()
        await scene.accept()
        await scene.said("the connection was closed", "up")

    play(script)


def test_uplink_without_pending_requests_is_not_reopened():
    async def script(scene):
        scene.hops.awaited = False
        scene.uplinks.send(scene.address, b"x")
        _, writer = await scene.accept()
        await scene.said("up")
        writer.close()
        await scene.said("up")
        scene.uplinks.send(scene.address, b"y")
        reader, _ = await scene.accept()
        assert await reader.read(1) == b"y"

    play(script)


def test_hop_without_a_route_is_tried_no_more():
    async def script(scene):
        scene.hops.wanted = False
        scene.listener.close()
        scene.uplinks.send(scene.address, b"x")
        await eventually(lambda: scene.hops.said[-1:] == ["up"])
        assert len(scene.hops.said) == 2

    play(script)


def test_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(mailbox_stream, "_MAX_WAITING", 1000)

    async def script(scene):
        assert scene.uplinks.send(scene.address, bytes(600)) is None
        why = scene.uplinks.send(scene.address, bytes(600))
        assert why == "the queue of the connection is full"
        await scene.accept()
        await scene.said("up")
        while scene.uplinks.send(scene.address, bytes(1 << 16)) is None:
            pass
        why = scene.uplinks.send(scene.address, b"x")
        assert why == "the peer does not read"

    play(script)


def test_connection_that_came_in_and_is_gone_is_not_made():
    async def script(scene):
        for name in ("127.0.0.1:4711#1", "somebody"):
            assert scene.uplinks.send(name, b"x") == "the connection is closed"

    play(script)
