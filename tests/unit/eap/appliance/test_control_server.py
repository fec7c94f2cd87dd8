"""The control server with real clients over socket pairs."""

from __future__ import annotations

import asyncio
import json
import socket

import pytest

from eap.appliance import control_server
from eap.appliance.bus_methods import Buses
from eap.appliance.control import MAX_LINE, MAX_SUBSCRIPTIONS
from eap.appliance.control_server import ControlServer
from eap.appliance.methods import Methods
from eap.errors import TornReadError

pytestmark = pytest.mark.net


async def torn():
    raise TornReadError("torn", writer="engine")


@pytest.fixture
def methods(files):
    return Methods({"plant": "demo"}, files, status=torn, stop=lambda: 1 / 0)


NO_BUSES = Buses((), None, {})


class Talk:
    """One client of a server, both in one loop."""

    def __init__(self, server: ControlServer) -> None:
        self._server = server

    async def __aenter__(self):
        ours, theirs = socket.socketpair()
        self.task = asyncio.ensure_future(self._server.serve_client(theirs))
        self.reader, self.writer = await asyncio.open_unix_connection(sock=ours, limit=2 * MAX_LINE)
        return self

    async def __aexit__(self, *_):
        self.writer.close()
        await asyncio.wait_for(self.task, 5)

    def say(self, line: str | bytes) -> None:
        self.writer.write((line.encode() if isinstance(line, str) else line) + b"\n")

    async def hear(self) -> dict:
        return json.loads(await asyncio.wait_for(self.reader.readline(), 5))

    async def ask(self, method: str, **params) -> dict:
        self.say(json.dumps({"v": 1, "id": 1, "method": method, "params": params}))
        return await self.hear()


def test_requests_are_answered_in_order(methods):
    async def talk():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            for number in range(3):
                client.say(f'{{"v":1,"id":{number},"method":"hello"}}')
            assert [(await client.hear())["id"] for _ in range(3)] == [0, 1, 2]

    asyncio.run(talk())


def test_refusals_keep_the_connection(methods):
    async def talk():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            client.say("what?")
            assert (await client.hear())["error"]["code"] == "bad_request"
            client.say('{"v":2,"id":7,"method":"hello"}')
            answer = await client.hear()
            assert (answer["id"], answer["error"]["code"]) == (7, "version")
            assert (await client.ask("helo"))["error"]["code"] == "unknown_method"
            assert (await client.ask("status"))["error"]["code"] == "unavailable"
            assert (await client.ask("stop"))["error"]["code"] == "internal"
            assert (await client.ask("hello"))["result"]["plant"] == "demo"

    asyncio.run(talk())


def test_a_line_without_end_is_refused_and_ends_the_connection(methods):
    async def talk():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            client.say(b"x" * (MAX_LINE + 1))
            assert "1048576" in (await client.hear())["error"]["message"]
            assert await client.reader.read() == b""

    asyncio.run(talk())


def test_subscriptions_run_beside_requests_until_unsubscribed(methods):
    async def talk():
        async with Talk(ControlServer(methods, NO_BUSES)) as client:
            answer = await client.ask("subscribe", station="left", names=["name"], period_ms=10)
            number = answer["result"]["subscription"]
            event = await client.hear()
            assert event["subscription"] == number
            assert event["event"]["values"] == {"name": "abc"}
            assert (await client.hear())["subscription"] == number
            client.say('{"v":1,"id":5,"method":"hello"}')
            while "result" not in (answer := await client.hear()):
                assert answer["subscription"] == number
            assert answer["id"] == 5
            params = json.dumps({"subscription": number})
            client.say(f'{{"v":1,"id":6,"method":"unsubscribe","params":{params}}}')
            while "result" not in (answer := await client.hear()):
                pass
            assert answer["result"] == {"unsubscribed": number}
            again = await client.ask("unsubscribe", subscription=number)
            assert again["error"]["code"] == "unknown_name"

    asyncio.run(talk())


def test_there_are_limits_on_subscriptions_and_clients(methods, monkeypatch):
    monkeypatch.setattr(control_server, "MAX_CLIENTS", 1)

    async def talk():
        server = ControlServer(methods, NO_BUSES)
        async with Talk(server) as client:
            for _ in range(MAX_SUBSCRIPTIONS):
                answer = await client.ask("subscribe", station="left", on="change", names=["name"])
                assert "result" in answer
                await client.hear()
            answer = await client.ask("subscribe", station="left")
            assert answer["error"]["code"] == "busy"
            async with Talk(server) as second:
                assert (await second.hear())["error"]["code"] == "busy"
                assert await second.reader.read() == b""
        async with Talk(server) as third:
            assert "result" in await third.ask("hello")

    asyncio.run(talk())


def test_who_does_not_read_is_disconnected(methods):
    async def talk():
        server = ControlServer(methods, NO_BUSES, slow_reader_s=0.05)
        ours, theirs = socket.socketpair()
        with ours:
            ours.sendall(b'{"v":1,"method":"variables","params":{"station":"left"}}\n' * 2000)
            await asyncio.wait_for(server.serve_client(theirs), 10)

    asyncio.run(talk())


def test_a_listener_serves_many(methods, tmp_path):
    async def talk():
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(tmp_path / "control"))
            listener.listen()
            serving = asyncio.ensure_future(ControlServer(methods, NO_BUSES).serve(listener))
            for _ in range(2):
                reader, writer = await asyncio.open_unix_connection(str(tmp_path / "control"))
                writer.write(b'{"v":1,"id":1,"method":"hello"}\n')
                assert json.loads(await reader.readline())["id"] == 1
                writer.close()
                await writer.wait_closed()
            serving.cancel()
            await asyncio.wait([serving])

    asyncio.run(talk())
