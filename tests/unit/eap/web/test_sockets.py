"""WebSockets of the page: topics, limits, values that grow stale."""

from __future__ import annotations

import asyncio
from time import monotonic

import pytest
from aiohttp import WSMsgType, WSServerHandshakeError

from eap.config.web_sections import TablePanel, WebSection
from eap.web import sockets
from tests.support.webplant import Site, StubPlant, of_type, page, play, subscribed

pytestmark = pytest.mark.net


def test_stale_pd_makes_its_values_stale():
    async def script(found: Site) -> None:
        found.plant.rx["state"] = "stale"
        client = await found.client()
        socket = await subscribed(client, "values:mixer/far")
        while (await of_type(socket, "values"))["values"]["mixer/far"][::2] != [7, True]:
            pass
        assert (await (await client.get("/api/v1/mixer/far")).json())["stale"]
        assert not (await (await client.get("/api/v1/mixer/speed")).json())["stale"]

    play(script)


def test_websocket_sends_values_of_a_page_as_they_change():
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await subscribed(client, "page:Line", "plant", "events")
        assert (await of_type(socket, "subscribed"))["errors"] == {}
        assert (await of_type(socket, "plant"))["stations"][0]["name"] == "mixer"
        found.plant.values["speed"] = 51.5
        while True:
            values = (await of_type(socket, "values"))["values"]
            if values["mixer/speed"][0] == 51.5:
                break
        value, age_us, is_stale = values["mixer/far"]
        assert (value, is_stale) == (7, False)
        assert age_us >= 300
        # Each subscribe replaces the topics before.
        await socket.send_json({"subscribe": []})
        assert (await of_type(socket, "subscribed"))["topics"] == []

    play(script)


def test_websocket_names_wrong_topics():
    async def script(found: Site) -> None:
        client = await found.client()
        topics = [
            "page:Lime",
            "values:speed",
            "x",
            "y" * 1000,
            *(f"values:a/{n}" for n in range(9)),
        ]
        socket = await subscribed(client, *topics)
        errors = (await of_type(socket, "subscribed"))["errors"]
        assert errors["page:Lime"] == "unknown page 'Lime', did you mean Line?"
        assert errors["values:a/8"] == "a connection has 8 topics at most"
        assert len(errors) == 5

    play(script)


@pytest.mark.parametrize("text", ["x", "[]", '{"subscribe": "x"}', '{"subscribe": [], "x": 1}'])
def test_websocket_with_a_wrong_message_is_closed(text):
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await client.ws_connect("/api/v1/ws")
        await socket.send_str(text)
        while (await socket.receive()).type is WSMsgType.TEXT:
            pass
        assert socket.close_code == 1007

    play(script)


def test_websocket_with_a_long_message_or_too_many_is_closed():
    async def script(found: Site) -> None:
        client = await found.client()
        for texts in (["x" * 5000], ['{"subscribe": []}'] * 50):
            socket = await client.ws_connect("/api/v1/ws")
            for text in texts:
                await socket.send_str(text)
            while (await socket.receive()).type is WSMsgType.TEXT:
                pass
            assert socket.close_code in {1008, 1009}

    play(script)


def test_number_of_websockets_is_bounded(monkeypatch):
    monkeypatch.setattr(sockets, "MAX_PER_HOST", 2)

    async def script(found: Site) -> None:
        client = await found.client()
        first = await client.ws_connect("/api/v1/ws")
        await client.ws_connect("/api/v1/ws")
        with pytest.raises(WSServerHandshakeError) as caught:
            await client.ws_connect("/api/v1/ws")
        assert caught.value.status == 503
        await first.close()
        while True:
            try:
                await client.ws_connect("/api/v1/ws")
            except WSServerHandshakeError:
                await asyncio.sleep(0.01)
            else:
                break

    play(script)


def test_client_that_does_not_read_stalls_nobody_and_is_disconnected(monkeypatch):
    monkeypatch.setattr(sockets, "SLOW_S", 1.0)
    plant = StubPlant()
    # More than the buffers of a connection hold within a second.
    plant.values["far"] = "x" * 2_000_000

    async def script(found: Site) -> None:
        reader = await found.client()
        host, port = reader.host, reader.port
        _, writer = await asyncio.open_connection(host, port, limit=1024)
        head = f"GET /api/v1/ws HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\n"
        head += "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        head += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        text = b'{"subscribe": ["values:mixer/far"]}'
        writer.write(head.encode() + bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text)
        socket = await subscribed(reader, "values:mixer/speed")
        began_s, seen = monotonic(), 0
        while len(found.server.sockets._open) < 2:
            await of_type(socket, "values")
        while len(found.server.sockets._open) > 1:
            await of_type(socket, "values")
            seen += 1
        assert seen > 3
        assert monotonic() - began_s < 30
        writer.transport.abort()

    play(script, WebSection(), plant)


def test_values_grow_stale_while_the_plant_does_not_answer_and_come_back():
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await subscribed(client, "values:mixer/speed")

        async def until(stale: bool) -> None:
            while (await of_type(socket, "values"))["values"]["mixer/speed"][2] is not stale:
                pass

        await until(stale=False)
        found.plant.answers = False
        await until(stale=True)
        async with client.get("/api/v1/mixer/speed") as answer:
            assert answer.status == 503
        found.plant.answers = True
        await until(stale=False)

    play(script)


def test_plant_that_ends_keeps_its_name_and_pages():
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await subscribed(client, "plant")
        found.plant.answers = False
        while not (await of_type(socket, "plant"))["unreachable"]:
            pass
        pages = (await (await client.get("/api/v1/pages")).json())["pages"]
        assert [each["name"] for each in pages] == ["line", "mixer"]
        assert (await (await client.get("/api/v1/session")).json())["plant"] == "line"

    play(script, WebSection())


def test_tables_are_sent_once_a_second():
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await subscribed(client, "page:All")
        while (await of_type(socket, "values"))["values"]["mixer/speed"][0] != 50.5:
            pass
        topic = found.server.topics._topics["page:All"]
        assert (topic.names[100], len(topic.names[1000])) == ([], 3)

    play(script, WebSection(pages=(page(TablePanel(), name="All"),)))
