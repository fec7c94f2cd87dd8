"""Connections of a station to all of its peers."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import asynccontextmanager, contextmanager

import pytest

from eap.ams.routes import Route
from eap.ams.transport_table import Transport
from eap.ids import Endpoint, NetId
from eap.services.transports.ams_tcp import AmsUplinks
from tests.support.eventually import eventually

pytestmark = pytest.mark.net


class Router:
    """Has transports and routes; knows which hops are up."""

    name = "left"

    def __init__(self, *routes: Route) -> None:
        self.table: list[Route] = list(routes)
        self.transports: dict[str, Transport] = {}
        self.up: set[Endpoint] = set()
        self.on_routes: list[Callable[[Endpoint], None]] = []

    def add(self, route: Route) -> None:
        self.table.append(route)
        self.on_routes[0](route.hop)

    def remove(self, route: Route) -> None:
        self.table.remove(route)
        self.on_routes[0](route.hop)

    def add_transport(self, transport, sender):
        assert transport.name not in self.transports
        self.transports[transport.name] = transport

    def remove_transport(self, name):
        del self.transports[name]

    def receive(self, data, transport, connection):
        raise AssertionError("nobody asks")

    def connection_closed(self, transport, connection):
        assert transport in self.transports
        self.up.discard(Endpoint(transport, connection))

    def hop_up(self, transport, address):
        assert transport in self.transports
        self.up.add(Endpoint(transport, address))

    def hop_down(self, transport, address, text):
        assert transport in self.transports


def route(address: str, net_id: str = "1.1.1.1.1.1", transport: str = "ams-tcp:") -> Route:
    return Route(NetId.parse(net_id), "plc", Endpoint(transport + address, address))


@asynccontextmanager
async def serving(*several: AmsUplinks):
    tasks = [asyncio.ensure_future(each.serve()) for each in several]
    try:
        await asyncio.sleep(0)
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        await asyncio.sleep(0)


@contextmanager
def listening():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener, f"127.0.0.1:{listener.getsockname()[1]}"


def accept(listener: socket.socket) -> socket.socket:
    """Take a connection that is there."""
    listener.setblocking(False)
    sock, _ = listener.accept()
    sock.settimeout(5)
    return sock


def test_one_connection_for_all_routes_to_a_peer_until_the_last_is_removed():
    async def run(listener, address):
        first, second = route(address), route(address, "1.1.1.2.1.1")
        router = Router(first)
        async with serving(AmsUplinks(router, [], [].append)):
            assert router.transports == {
                first.hop.transport: Transport(first.hop.transport, is_stream=True, is_hub=True)
            }
            router.add(second)
            await eventually(lambda: router.up == {first.hop})
            router.remove(first)
            assert router.up == {first.hop}
            with accept(listener) as sock:
                with pytest.raises(BlockingIOError):
                    listener.accept()
                router.remove(second)
                assert router.transports == {}
                await asyncio.sleep(0)
                assert sock.recv(1) == b""
            router.up.clear()
            router.add(first)
            await eventually(lambda: router.up)
            accept(listener).close()
        assert router.up == set()

    with listening() as there:
        asyncio.run(run(*there))


def test_two_stations_have_a_connection_each():
    async def run(listener, address):
        routers = Router(route(address)), Router(route(address))
        async with serving(*(AmsUplinks(each, [], [].append) for each in routers)):
            await eventually(lambda: all(each.up for each in routers))
            for _ in routers:
                accept(listener).close()

    with listening() as there:
        asyncio.run(run(*there))


def test_uplinks_ignore_routes_of_other_transports():
    router = Router(route("eap0", transport="udp:"))
    AmsUplinks(router, [], [].append)
    router.add(route("eap0", transport="ams-tcp"))
    assert router.transports == {}


def test_uplinks_log_an_invalid_address(caplog):
    router = Router(route("plc:nothing"))
    AmsUplinks(router, [], [].append)
    assert router.transports == {}
    assert "'nothing' is not a port" in caplog.messages[0]
