"""The connection of a station to a peer."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from contextlib import asynccontextmanager

import pytest

from eap.services.transports import ams_tcp
from eap.services.transports.ams_tcp import AmsUplink, PeerAddress, source_for
from tests.support import aoe
from tests.support.eventually import eventually

pytestmark = pytest.mark.net

WAY = ("ams-tcp:plc", "plc:48898")
TARGET = "1.1.1.1.2.1"


def packet(body: bytes = b"", flags: int = 4) -> bytes:
    return aoe.packet(TARGET, aoe.READ_STATE, body, flags=flags)


class Router:
    """Notes what an uplink tells it."""

    name = "left"

    def __init__(self) -> None:
        self.seen: list[str | bytes] = []
        self.went_on = asyncio.Event()

    def receive(self, data, transport, connection):
        assert (transport, connection) == WAY
        self._note(data)

    def connection_closed(self, transport, connection):
        assert (transport, connection) == WAY
        self._note("closed")

    def hop_down(self, transport, address, text):
        assert (transport, address) == WAY
        self._note(text)

    def hop_up(self, transport, address):
        assert (transport, address) == WAY
        self._note("up")

    def _note(self, what):
        self.seen.append(what)
        self.went_on.set()

    async def until(self, *what: str | bytes) -> None:
        """Wait until this, and nothing else, was seen since the last call."""
        while len(self.seen) < len(what):
            self.went_on.clear()
            await asyncio.wait_for(self.went_on.wait(), 5)
        assert self.seen == list(what)
        self.seen.clear()


class Plc:
    """A peer that says what the test wants."""

    def __init__(self) -> None:
        self.streams: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]]
        self.streams = asyncio.Queue()

    async def take(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.wait_for(self.streams.get(), 5)

    async def connected(self, reader, writer) -> None:
        await self.streams.put((reader, writer))


@asynccontextmanager
async def listening(port: int = 0):
    """Run a peer; yield it and its port."""
    plc = Plc()
    server = await asyncio.start_server(plc.connected, "127.0.0.1", port, reuse_address=True)
    try:
        yield plc, server.sockets[0].getsockname()[1]
    finally:
        server.close()
        while not plc.streams.empty():
            plc.streams.get_nowait()[1].transport.abort()


@asynccontextmanager
async def serving(port: int, host: str = "127.0.0.1", claims=None, **more):
    """Run an uplink; yield it, its router and what it refused."""
    router, refused = Router(), []
    uplink = AmsUplink(
        PeerAddress(host, port),
        *WAY,
        router,
        sources=["127.9.77.1"],
        claims={} if claims is None else claims,
        count_dropped=refused.append,
        **more,
    )
    task = asyncio.ensure_future(uplink.run())
    try:
        yield uplink, router, refused
    finally:
        task.cancel()
        await asyncio.wait([task])
        await asyncio.sleep(0)


async def hear(reader) -> bytes:
    _, length = struct.unpack("<HI", await reader.readexactly(6))
    return await reader.readexactly(length)


def prefixed(octets: bytes) -> bytes:
    return struct.pack("<HI", 0, len(octets)) + octets


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as sock:
        return sock.getsockname()[1]


@pytest.fixture(autouse=True)
def short_waits(monkeypatch):
    monkeypatch.setattr(ams_tcp, "FIRST_WAIT_S", 0.05)


def test_uplink_sends_early_packets_when_connected():
    async def run():
        async with listening() as (plc, port), serving(port) as (uplink, router, _):
            assert uplink.send("", [packet(b"early")]) is None
            reader, writer = await plc.take()
            assert writer.get_extra_info("peername")[0] == "127.9.77.1"
            await router.until("up")
            assert uplink.send("", [packet(b"late")]) is None
            assert [await hear(reader), await hear(reader)] == [packet(b"early"), packet(b"late")]
            writer.close()

    asyncio.run(run())


def test_uplink_forwards_answers_and_requests_of_the_peer():
    async def run():
        async with listening() as (plc, port), serving(port) as (uplink, router, _):
            reader, writer = await plc.take()
            writer.write(prefixed(packet(b"question")) + prefixed(packet(b"answer", 5)))
            await router.until("up", packet(b"question"), packet(b"answer", 5))
            uplink.send("", [packet(b"there", 5)])
            assert await hear(reader) == packet(b"there", 5)
            writer.close()

    asyncio.run(run())


def test_too_much_does_not_wait_for_a_connection(monkeypatch):
    monkeypatch.setattr(ams_tcp, "MAX_EARLY", 2)

    async def run():
        async with listening() as (plc, port), serving(port) as (uplink, _, _):
            assert [uplink.send("", [packet()]) for _ in range(3)] == [
                None,
                None,
                "not connected yet",
            ]
            _, writer = await plc.take()
            writer.close()

    asyncio.run(run())


def test_peer_that_refuses_is_tried_again_until_it_is_there():
    async def run():
        port = free_port()
        async with serving(port) as (uplink, router, _):
            assert uplink.send("", [packet()]) is None
            text = f"127.0.0.1:{port} refuses connections: no router runs there"
            await router.until(text)
            assert uplink.send("", [packet()]) == "not connected"
            await router.until(text, text)
            async with listening(port) as (plc, _):
                _, writer = await plc.take()
                await eventually(lambda: "up" in router.seen)
                writer.close()

    asyncio.run(run())


def test_log_says_once_why_there_is_no_connection_and_when_there_is(caplog):
    async def run():
        port = free_port()
        async with serving(port, overdue_ns=200_000_000) as (_, router, _):
            await eventually(lambda: len(router.seen) == 3)
            async with listening(port) as (plc, _):
                _, writer = await plc.take()
                await eventually(lambda: len(caplog.messages) == 2)
                writer.close()
                await eventually(lambda: len(caplog.messages) == 3)
            refuses, connected, closed = caplog.messages
            assert refuses == f"left: 127.0.0.1:{port} refuses connections: no router runs there"
            assert connected == f"left: connected to 127.0.0.1:{port}"
            assert "closes connections at once" in closed

    with caplog.at_level(logging.INFO):
        asyncio.run(run())


def test_uplink_to_a_client_that_does_not_listen_is_no_warning_until_it_listened(caplog):
    async def run():
        port = free_port()
        async with serving(port, may_be_client=lambda: True) as (_, router, _):
            await eventually(lambda: len(caplog.messages) == 1)
            async with listening(port) as (plc, _):
                _, writer = await plc.take()
                await eventually(lambda: "up" in router.seen)
                writer.transport.abort()
            await eventually(lambda: caplog.records[-1].levelname == "WARNING")

    with caplog.at_level(logging.INFO):
        asyncio.run(run())
    assert caplog.records[0].levelname == "INFO"
    assert caplog.messages[0].endswith("a client added the route to it, and does not listen")


def test_connection_that_is_lost_is_opened_again():
    async def run():
        async with listening() as (plc, port), serving(port) as (uplink, router, _):
            for _ in range(2):
                _, writer = await plc.take()
                await router.until("up")
                writer.write(prefixed(packet(b"question")))
                await router.until(packet(b"question"))
                writer.transport.abort()
                why = (
                    f"127.0.0.1:{port} closes connections at once: it may have no route back"
                    " (closed by the peer)"
                )
                await router.until("closed", why)
                assert uplink.send("", [packet()]) == "not connected"

    asyncio.run(run())


def test_uplink_closes_after_invalid_packets():
    async def run():
        async with listening() as (plc, port), serving(port) as (_, router, refused):
            _, writer = await plc.take()
            writer.write(b"GET / HTTP/1.1\r\n")
            await eventually(lambda: len(router.seen) == 3)
            assert router.seen[:2] == ["up", "closed"]
            assert "no AMS packets" in router.seen[2]
            assert [str(each) for each in refused] == ["ams_type"]
            writer.close()

    asyncio.run(run())


def test_uplink_forwards_long_answers_and_rejects_longer_ones():
    async def run():
        async with listening() as (plc, port), serving(port) as (_, router, refused):
            _, writer = await plc.take()
            long = packet(bytes(1 << 20), 5)
            writer.write(prefixed(long))
            await router.until("up", long)
            writer.write(prefixed(packet(bytes(5 << 20), 5)))
            await router.until(packet(b"", 5)[:24] + b"\x0e\0\0\0\1\0\0\0")
            assert [str(each) for each in refused] == ["ams_length"]
            writer.transport.abort()

    asyncio.run(run())


def test_uplink_closes_when_the_peer_stops_reading():
    async def run():
        async with listening() as (plc, port), serving(port, overdue_ns=400_000_000) as (
            uplink, router, refused,
        ):  # fmt: skip
            _, writer = await plc.take()
            await router.until("up")
            why = None
            while why is None:
                why = uplink.send("", [packet(bytes(1 << 20))])
            assert why == "the peer does not read"
            writer.write(prefixed(packet(b"answer", 5)))
            await router.until(packet(b"answer", 5))
            await eventually(lambda: len(router.seen) == 2)
            assert "too slow" in router.seen[1]
            assert [str(each) for each in refused] == ["ams_slow"]
            writer.transport.abort()

    asyncio.run(run())


def test_uplink_to_unknown_host_name_reports_it():
    async def run():
        async with serving(1, "a..b") as (_, router, _):
            await router.until("a..b: no address: 'a..b' is not a host name")

    asyncio.run(run())


def test_two_names_of_one_peer_are_not_two_connections():
    async def run():
        claims = {}
        async with listening() as (plc, port):
            async with serving(port, claims=claims) as (_, router, _):
                _, writer = await plc.take()
                await router.until("up")
                async with serving(port, "localhost", claims) as (_, other, _):
                    await other.until(
                        f"localhost:{port} is 127.0.0.1:{port}, to which there is a route:"
                        " name both alike"
                    )
                assert plc.streams.empty()
                writer.close()
            assert claims == {}

    asyncio.run(run())


def test_peer_that_does_not_answer_is_given_up(monkeypatch):
    monkeypatch.setattr(ams_tcp, "CONNECT_S", 0.1)

    async def run():
        with socket.create_server(("127.0.0.1", 0), backlog=0) as full:
            port = full.getsockname()[1]
            crowd = [socket.socket() for _ in range(4)]
            for each in crowd:
                each.setblocking(False)
                each.connect_ex(("127.0.0.1", port))
            async with serving(port) as (_, router, _):
                await router.until(f"127.0.0.1:{port} does not answer within 0.1 s")
            for each in crowd:
                each.close()

    asyncio.run(run())


def test_route_that_is_removed_closes_the_connection_at_once():
    async def run():
        async with listening() as (plc, port), serving(port) as (uplink, router, _):
            reader, writer = await plc.take()
            await router.until("up")
            uplink.end()
            await router.until("closed")
            assert await reader.read() == b""
            uplink.end()
            assert router.seen in ([], [router.seen[-1]])
            writer.close()

    asyncio.run(run())


@pytest.mark.parametrize(
    ("host", "source"),
    [
        ("127.0.0.9", "127.0.1.1"),
        ("10.1.2.9", "10.1.2.3"),
        ("10.1.3.9", None),
        ("8.8.8.8", None),
    ],
)
def test_station_comes_from_its_own_address_where_that_is_in_the_peers_network(host, source):
    assert source_for(host, ["127.0.1.1", "127.0.1.2", "10.1.2.3"]) == source
