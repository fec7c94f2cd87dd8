"""The page's server by HTTP, on a plant without processes: values, writes, files, connections."""

from __future__ import annotations

import asyncio
import json
import ssl
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from eap.config.web_sections import CommentRule, PicturePanel, SetPanel, WebSection, WebTls
from eap.errors import EnvironmentalError
from eap.live.view import LiveView
from eap.web import guard, server
from eap.web.process import session_key
from tests.support.passwords import PASSWORD
from tests.support.webplant import (
    CLOSED,
    KEY,
    SETPOINT,
    Site,
    basic,
    of_type,
    page,
    play,
    reason,
    stub_client,
    subscribed,
)

pytestmark = pytest.mark.net


def test_value_has_unit_quality_and_age():
    async def script(found: Site) -> None:
        client = await found.client()
        own = await (await client.get("/api/v1/mixer/speed")).json()
        assert own | {"age_us": 0, "time": 0} == {
            "value": 50.5, "unit": "1/min", "quality": None, "age_us": 0, "time": 0, "stale": False,
        }  # fmt: skip
        far = await (await client.get("/api/v1/mixer/far")).json()
        assert (far["value"], far["quality"], far["stale"]) == (7, 3, False)
        assert 300 <= far["age_us"] < 1_000_000

    play(script)


def test_wildcards_read_several_values_by_name():
    async def script(found: Site) -> None:
        client = await found.client()
        values = await (await client.get("/api/v1/*/s*")).json()
        assert {name: each["value"] for name, each in values.items()} == {
            "mixer/speed": 50.5,
            "mixer/setpoint": 40,
        }
        states = await (await client.get("/api/v1/*/state")).json()
        assert states["mixer/state"]["value"] == "OP"

    play(script)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("/api/v1/mixer/nothing", "no variable 'nothing'"),
        ("/api/v1/mixr/speed", "unknown station 'mixr', did you mean mixer?"),
        ("/api/v1/*/nothing*", "no variable fits '*/nothing*'"),
        ("/api/v1/history/mixer/far", "no trend of a page shows 'mixer/far'"),
        ("/api/v1/pictures/0/0", "the panel is no picture"),
        ("/api/v1/pictures/9/0", "no such panel"),
        ("/nothing.js", "Not Found"),
        ("/..%2fserver.py", "Not Found"),
        ("/../server.py", "Not Found"),
        ("/%2e%2e/server.py", "Not Found"),
    ],
)
def test_unknown_path_is_refused_with_a_reason(path, message):
    async def script(found: Site) -> None:
        client = await found.client()
        async with client.get(path) as answer:
            assert (answer.status, await reason(answer)) == (404, message)

    play(script)


def test_page_has_a_strict_policy_and_no_inline_script():
    async def script(found: Site) -> None:
        client = await found.client()
        async with client.get("/") as answer:
            text = await answer.text()
            policy = answer.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'self';")
        assert "unsafe" not in policy
        assert text.count("<script") == text.count(' src="')
        assert "<style" not in text
        assert " style=" not in text
        assert "aiohttp" not in str(answer.headers)
        again = await client.get("/", headers={"If-None-Match": answer.headers["ETag"]})
        assert again.status == 304

    play(script)


def test_openapi_names_every_path():
    async def script(found: Site) -> None:
        client = await found.client()
        described = await (await client.get("/openapi.json")).json()
        assert described["openapi"] == "3.1.0"
        served = {route.path for route in found.server.api.routes()} - {"/openapi.json"}
        shown = served - {"/api/v1/pictures/{page}/{panel}"} | {"/metrics"}
        assert set(described["paths"]) == shown

    play(script)


def test_write_without_users_sets_within_the_limits_of_the_panel():
    async def script(found: Site) -> None:
        client = await found.client()
        async with client.post(SETPOINT, json={"value": 75}) as answer:
            assert await answer.json() == {"written": "mixer/setpoint", "value": 75}
        (written,) = found.plant.written
        assert written["values"] == {"setpoint": 75}
        assert (written["origin"].user, written["origin"].host) == ("", "127.0.0.1")
        for value, why in (
            (9, "9 is below the smallest value, 10"),
            (91, "91 is above the largest value, 90"),
            ("x", "'x' is not a number"),
            (True, "True is not a number"),
        ):
            async with client.post(SETPOINT, json={"value": value}) as answer:
                refused = (answer.status, await reason(answer))
                assert refused == (422, f"mixer/setpoint: {why}")
        assert len(found.plant.written) == 1

    play(script)


def test_value_that_a_browser_sets_is_an_event():
    async def script(found: Site) -> None:
        browser, headers = await found.log_in("otto")
        socket = await subscribed(browser, "events")
        body = {"value": 45, "comment": "new recipe"}
        await browser.post(SETPOINT, json=body, headers=headers)
        while not (events := (await of_type(socket, "events"))["events"]):
            pass
        event = events[-1]
        assert (event["severity"], event["where"]) == ("info", "mixer/setpoint")
        assert event["what"] == "set to 45 1/min by otto: new recipe"
        program = await found.client()
        await program.post(SETPOINT, json={"value": 46}, headers=basic("elsa", PASSWORD))
        events = (await (await browser.get("/api/v1/events")).json())["events"]
        assert sum(each["where"] == "mixer/setpoint" for each in events) == 1

    play(script, CLOSED)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("null", "mixer/setpoint: null is not a value"),
        ("9" * 400, f"mixer/setpoint: {'9' * 60}… is above the largest value, 90"),
        (f'"{"x" * 400}"', f"mixer/setpoint: '{'x' * 59}… is not a number"),
    ],
)
def test_write_of_what_is_no_value_is_refused(value, message):
    async def script(found: Site) -> None:
        client = await found.client()
        body, headers = f'{{"value": {value}}}', {"Content-Type": "application/json"}
        async with client.post(SETPOINT, data=body, headers=headers) as answer:
            assert (answer.status, await reason(answer)) == (422, message)
        assert not found.plant.written

    play(script)


def test_defect_of_a_handler_is_answered_without_its_text(monkeypatch, caplog):
    async def script(found: Site) -> None:
        monkeypatch.setattr(found.server.feed, "events", None)
        client = await found.client()
        async with client.get("/api/v1/events") as answer:
            assert (answer.status, await reason(answer)) == (
                500,
                "the page's server failed: see its log",
            )
            assert "Content-Security-Policy" in answer.headers
        assert "GET '/api/v1/events' failed" in caplog.text

    play(script)


def test_write_needs_the_comment_that_the_panel_requires():
    panel = SetPanel(of="mixer/setpoint", comment=CommentRule.REQUIRED)

    async def script(found: Site) -> None:
        client = await found.client()
        async with client.post(SETPOINT, json={"value": 5, "comment": " "}) as answer:
            assert answer.status == 422
            assert "a comment is required" in await reason(answer)
        async with client.post(SETPOINT, json={"value": 5, "comment": "trial"}) as answer:
            assert answer.status == 200
        assert found.plant.written[0]["origin"].comment == "trial"

    play(script, WebSection(pages=(page(panel),)))


@pytest.mark.parametrize(
    "body", ["", "x", "[]", "{}", '{"value": 1, "valu": 2}', '{"value": 1, "comment": 2}',
             '{"value": NaN}', '{"value": 1e999}', r'{"value": "\ud800"}',
             "[" * 100_000, f'{{"value": 1, "comment": "{"x" * 201}"}}'],
)  # fmt: skip
def test_write_with_a_wrong_body_is_refused(body):
    async def script(found: Site) -> None:
        client = await found.client()
        headers = {"Content-Type": "application/json"}
        async with client.post(SETPOINT, data=body, headers=headers) as answer:
            assert answer.status in {400, 413}
        assert not found.plant.written

    play(script)


def test_write_of_a_form_is_refused():
    async def script(found: Site) -> None:
        client = await found.client()
        async with client.post(SETPOINT, data={"value": "1"}) as answer:
            assert answer.status == 415

    play(script)


def test_body_and_line_of_a_request_are_bounded():
    async def script(found: Site) -> None:
        client = await found.client()
        body = '{"value": "' + "x" * guard.MAX_BODY + '"}'
        headers = {"Content-Type": "application/json"}
        async with client.post(SETPOINT, data=body, headers=headers) as answer:
            assert answer.status == 413
        async with client.get("/api/v1/mixer/" + "x" * 9000) as answer:
            assert answer.status == 400

    play(script)


def test_picture_of_a_page_has_nothing_that_runs(tmp_path):
    file = tmp_path / "line.svg"
    file.write_text(
        '<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script>'
        '<rect id="tank" onclick="alert(2)" style="fill:red"/></svg>'
    )
    section = WebSection(pages=(page(PicturePanel(file=str(file))),))

    async def script(found: Site) -> None:
        client = await found.client()
        async with client.get("/api/v1/pictures/0/0") as answer:
            assert answer.content_type == "image/svg+xml"
            assert "sandbox" in answer.headers["Content-Security-Policy"]
            text = await answer.text()
        assert "alert" not in text
        assert '<rect id="tank" fill="red">' in text
        pages = await (await client.get("/api/v1/pages")).json()
        assert str(tmp_path) not in json.dumps(pages)

    play(script, section)


def test_default_pages_are_one_of_the_plant_and_one_a_station():
    async def script(found: Site) -> None:
        client = await found.client()
        pages = (await (await client.get("/api/v1/pages")).json())["pages"]
        assert [each["name"] for each in pages] == ["line", "mixer"]
        kinds = [panel["kind"] for panel in pages[1]["panels"]]
        assert kinds == ["plant", "variables", "bus", "routes", "events"]

    play(script, WebSection())


def test_metrics_count_plants_that_do_not_answer():
    async def script(found: Site) -> None:
        client = await found.client()
        while "eap_unreachable{} 0\n" not in await (await client.get("/metrics")).text():
            pass
        found.plant.answers = False
        while "eap_unreachable{} 1\n" not in await (await client.get("/metrics")).text():
            pass

    play(script)


def test_silent_station_hides_no_other_from_wildcards():
    async def script(found: Site) -> None:
        client = await found.client()
        before = found.server.feed.directories["mixer"]
        found.server.feed.directories["mill"] = before  # another appliance, which has ended
        values = await (await client.get("/api/v1/*/speed")).json()
        assert values["mixer/speed"]["value"] == 50.5
        assert values["mill/speed"]["value"] is None
        assert values["mill/speed"]["stale"]
        async with client.get("/api/v1/mill/speed") as answer:
            assert (answer.status, await reason(answer)) == (503, "station mill does not answer")

    play(script)


def test_history_keeps_the_values_of_trends_without_a_browser():
    async def script(found: Site) -> None:
        client = await found.client()
        while True:
            async with client.get("/api/v1/history/mixer/*?window=10m") as answer:
                history = (await answer.json())["mixer/speed"]
            if 50.5 in history["values"]:
                break
            await asyncio.sleep(0.05)
        assert history["unit"] == "1/min"
        assert len(history["times"]) == len(history["values"])
        async with client.get("/api/v1/history/mixer/speed?window=x") as answer:
            assert answer.status == 400

    play(script)


@asynccontextmanager
async def silent_connections(port: int, number: int) -> AsyncIterator[list[asyncio.Task[bytes]]]:
    """Serve on *port*, and give the reading of connections that send nothing."""
    section = WebSection(listen=f"127.0.0.1:{port}")
    with server.open_listener(section) as listener:
        async with asyncio.timeout(60), LiveView(remote={"line": stub_client()}) as view:
            page_server = server.PageServer(section, view, KEY)
            async with server.serving(page_server.application(), listener, None):
                opened = [await asyncio.open_connection("127.0.0.1", port) for _ in range(number)]
                ends = [asyncio.ensure_future(reader.read()) for reader, _ in opened]
                yield ends
                for _, writer in opened:
                    writer.close()
                await asyncio.wait(ends)


def test_connections_of_a_host_are_bounded(monkeypatch):
    monkeypatch.setattr(server, "MAX_PER_HOST", 3)

    async def script() -> None:
        async with silent_connections(18321, 5) as ends:
            while sum(each.done() for each in ends) < 2:
                await asyncio.wait(
                    [each for each in ends if not each.done()], return_when=asyncio.FIRST_COMPLETED
                )
            assert [each.done() for each in ends] == [False] * 3 + [True] * 2

    asyncio.run(script())


def test_silent_connections_are_closed(monkeypatch):
    monkeypatch.setattr(server, "_KEEPALIVE_S", 0.2)

    async def script() -> None:
        async with silent_connections(18323, 3) as ends:
            await asyncio.wait(ends)
            assert [each.result() for each in ends] == [b""] * 3

    asyncio.run(script())


def test_tls_connection_that_does_not_end_stops_no_other(tmp_path, monkeypatch):
    made = []

    class Seen(server.Connections):
        def __init__(self, *given):
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr(server, "Connections", Seen)
    section = WebSection(listen="127.0.0.1:18324", tls=certificate(tmp_path))
    trust = ssl.create_default_context(cafile=section.tls.certificate)

    async def script() -> None:
        with server.open_listener(section) as listener:
            async with asyncio.timeout(60), LiveView(remote={"line": stub_client()}) as view:
                application = server.PageServer(section, view, KEY).application()
                context = server.tls_context(section)
                async with server.serving(application, listener, context):
                    reader, silent = await asyncio.open_connection("127.0.0.1", 18324, ssl=trust)
                    reader._transport.pause_reading()
                    while not made[0]._server.connections:  # noqa: ASYNC110  it does not tell
                        await asyncio.sleep(0)
                    (handler,) = made[0]._server.connections
                    # asyncio forgets the protocol of a transport that is closed twice.
                    handler.transport.close()
                    handler.transport.close()
                    reader, writer = await asyncio.open_connection("127.0.0.1", 18324, ssl=trust)
                    writer.write(b"GET /icon.svg HTTP/1.1\r\nHost: localhost\r\n\r\n")
                    assert (await reader.readline()).startswith(b"HTTP/1.1 200")
                    writer.close()
                    silent.transport.abort()

    asyncio.run(script())


def certificate(folder: Path) -> WebTls:
    """Make a certificate of this host, and return it with its key."""
    tls = WebTls(certificate=str(folder / "page.crt"), key=str(folder / "page.key"))
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-subj", "/CN=page", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", tls.key, "-out", tls.certificate],
        capture_output=True, check=True,
    )  # fmt: skip
    return tls


def test_port_in_use_is_named():
    section = WebSection(listen="127.0.0.1:18322")
    with (
        server.open_listener(section),
        pytest.raises(EnvironmentalError, match=r"cannot listen on 127\.0\.0\.1:18322"),
    ):
        server.open_listener(section)


def test_wrong_certificate_is_named(tmp_path):
    file = tmp_path / "page.crt"
    file.write_text("no certificate")
    tls = WebTls(certificate=str(file), key=str(file))
    with pytest.raises(EnvironmentalError, match=r"web: tls: .*page\.crt"):
        server.tls_context(WebSection(tls=tls))


def test_session_key_is_kept_and_private(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    key = session_key("line")
    file = tmp_path / "line" / "web.key"
    assert (len(key), session_key("line"), file.stat().st_mode & 0o777) == (32, key, 0o600)
    # Others may have read it, or written it.
    file.chmod(0o644)
    assert session_key("line") != key
    assert file.stat().st_mode & 0o777 == 0o600
    file.write_bytes(b"short")
    assert len(session_key("line")) == 32
