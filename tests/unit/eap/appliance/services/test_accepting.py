"""Connections of clients: accepted and named."""

from __future__ import annotations

import asyncio
import socket

import pytest

from eap.appliance.services import accepting
from eap.appliance.services.accepting import accept_connections, connection_name

pytestmark = pytest.mark.net


def test_connections_are_counted_before_they_run(monkeypatch, caplog):
    monkeypatch.setattr(accepting, "_PAUSE_S", 0.0)
    accepted: list[tuple[str, int]] = []

    async def answer(connection):
        with connection:
            await asyncio.get_running_loop().sock_sendall(connection, b"x")

    def serve(connection, address):
        accepted.append(address)
        if len(accepted) == 2:
            connection.close()
            return None
        return answer(connection)

    async def script():
        with socket.create_server(("127.0.0.1", 0)) as listener:
            serving = asyncio.ensure_future(accept_connections(listener, "test", serve))
            heard = []
            for _ in range(3):
                reader, writer = await asyncio.open_connection(*listener.getsockname())
                heard.append((await reader.read(), writer.get_extra_info("sockname")))
                writer.close()
            serving.cancel()
            await asyncio.wait([serving])
        return heard

    heard = asyncio.run(script())
    assert [octets for octets, _ in heard] == [b"x", b"", b"x"]
    assert accepted == [name for _, name in heard]


def test_listener_that_fails_is_asked_again(monkeypatch, caplog):
    monkeypatch.setattr(accepting, "_PAUSE_S", 0.0)

    async def script():
        with socket.socket() as listener:  # which does not listen
            serving = asyncio.ensure_future(accept_connections(listener, "test", lambda *_: None))
            while len(caplog.messages) < 3:  # noqa: ASYNC110
                await asyncio.sleep(0)
            serving.cancel()
            await asyncio.wait([serving])

    asyncio.run(script())
    assert caplog.messages[0] == "test listener: Invalid argument"


def test_no_two_connections_have_the_same_name():
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, socket.create_connection(listener.getsockname()) as one:
        here = "{}:{}#".format(*listener.getsockname())
        names = [connection_name(one) for _ in range(2)]
    assert len(set(names)) == 2
    assert all(name.startswith(here) for name in names)
    with socket.socket() as gone:
        assert connection_name(gone).startswith(":0#")
    pair = socket.socketpair()
    assert connection_name(pair[0]).startswith(":0#")
    for each in pair:
        each.close()
