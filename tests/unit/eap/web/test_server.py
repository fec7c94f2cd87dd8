"""The page's server by HTTP and WebSocket, on a plant without processes."""

from __future__ import annotations

import asyncio
import json
import ssl
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from time import monotonic

import pytest
from aiohttp import WSMsgType, WSServerHandshakeError, encode_basic_auth
from msgspec.structs import replace

from eap.ams.spec import Role
from eap.config.web_sections import (
    CommentRule,
    PicturePanel,
    SetPanel,
    TablePanel,
    TrendPanel,
    ValuePanel,
    WebProxy,
    WebSection,
    WebTls,
)
from eap.errors import EnvironmentalError
from eap.live.view import LiveView
from eap.runtime.logins import FREE_FAILURES
from eap.web import guard, server, sockets
from eap.web.process import session_key
from tests.support.webplant import KEY, PASSWORD, USERS, Site, StubPlant, page, site, stub_client

pytestmark = pytest.mark.net

SET = SetPanel(of="mixer/setpoint", low=10, high=90)
PANELS = (ValuePanel(of="mixer/*"), TrendPanel(of="mixer/speed", window="10m"), SET)
OPEN = WebSection(pages=(page(*PANELS),))
CLOSED = replace(OPEN, users=USERS)
SETPOINT = "/api/v1/mixer/setpoint"


def play(
    script: Callable[[Site], Awaitable[None]],
    section: WebSection = OPEN,
    plant: StubPlant | None = None,
) -> None:
    async def run() -> None:
        async with site(section, plant) as found:
            await script(found)

    asyncio.run(run())


def basic(name: str, password: str) -> dict[str, str]:
    return {"Authorization": encode_basic_auth(name, password)}


async def reason(answer) -> str:
    return (await answer.json())["error"]["message"]


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


def test_password_that_is_no_text_is_refused():
    async def script(found: Site) -> None:
        client = await found.client()
        body, headers = (
            r'{"user": "otto", "password": "\ud800"}',
            {"Content-Type": "application/json"},
        )
        async with client.post("/api/v1/login", data=body, headers=headers) as answer:
            assert answer.status == 400

    play(script, CLOSED)


@pytest.mark.parametrize(
    "name",
    ["Host", "Origin", "Cookie", "Authorization", "X-CSRF-Token", "Content-Type", "X-Remote-User",
     "X-Forwarded-For", "Sec-Fetch-Site"],
)  # fmt: skip
def test_header_that_is_no_text_is_no_defect(name):
    async def script(found: Site) -> None:
        client = await found.client()
        reader, writer = await asyncio.open_connection(client.host, client.port)
        given = {b"Host": b"localhost", b"Content-Type": b"application/json"}
        given |= {name.encode(): b"eap-session=\xff" if name == "Cookie" else b"Basic http://\xff"}
        lines = [b"POST /api/v1/mixer/setpoint HTTP/1.1", b"Content-Length: 11"]
        lines += [b"%s: %s" % each for each in given.items()]
        writer.write(b"\r\n".join([*lines, b"", b'{"value":1}']))
        status = (await reader.readline()).split()[1]
        assert status in {b"400", b"401", b"403", b"415", b"422"}
        writer.close()

    play(script, replace(CLOSED, anonymous=Role.VIEWER, proxy=WebProxy(header="X-Remote-User")))


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


def test_without_login_users_see_nothing():
    async def script(found: Site) -> None:
        client = await found.client()
        session = await (await client.get("/api/v1/session")).json()
        assert (session["user"], session["role"], session["can_log_in"]) == (None, None, True)
        for path in ("status", "plant", "pages", "variables", "events", "mixer/speed",
                     "history/mixer/speed", "routes/mixer/", "pictures/0/0", "ws"):  # fmt: skip
            async with client.get(f"/api/v1/{path}") as answer:
                assert answer.status == 401, path
        async with client.post(SETPOINT, json={"value": 50}) as answer:
            assert answer.status == 401

    play(script, CLOSED)


def test_anonymous_viewer_sees_and_sets_nothing():
    async def script(found: Site) -> None:
        client = await found.client()
        assert (await client.get("/api/v1/mixer/speed")).status == 200
        async with client.post(SETPOINT, json={"value": 50}) as answer:
            message = "mixer/setpoint is set by operators: your role is viewer"
            assert (answer.status, await reason(answer)) == (403, message)

    play(script, replace(CLOSED, anonymous=Role.VIEWER))


@pytest.mark.parametrize(
    ("name", "variable", "status"),
    [
        ("vera", "setpoint", 403),
        ("otto", "setpoint", 200),
        ("otto", "speed", 403),
        ("elsa", "setpoint", 200),
        ("elsa", "speed", 200),
    ],
)
def test_role_decides_about_a_write(name, variable, status):
    async def script(found: Site) -> None:
        browser, headers = await found.log_in(name)
        path = f"/api/v1/mixer/{variable}"
        async with browser.post(path, json={"value": 50}, headers=headers) as answer:
            assert answer.status == status
        written = [each["origin"].user for each in found.plant.written]
        assert written == ([name] if status == 200 else [])

    play(script, CLOSED)


def test_change_by_a_browser_needs_the_token_of_its_session():
    async def script(found: Site) -> None:
        browser, headers = await found.log_in("otto")
        _, others = await found.log_in("elsa")
        for token in ("", "x", "ü", others["X-CSRF-Token"]):
            wrong = headers | {"X-CSRF-Token": token}
            async with browser.post(SETPOINT, json={"value": 50}, headers=wrong) as answer:
                assert (answer.status, "X-CSRF-Token" in await reason(answer)) == (403, True)
        # Without Origin, too: the cookie alone is no proof.
        async with browser.post(SETPOINT, json={"value": 50}) as answer:
            assert answer.status == 403
        assert not found.plant.written

    play(script, CLOSED)


@pytest.mark.parametrize(
    "header", [{"Origin": "http://evil.example"}, {"Origin": "null"},
               {"Sec-Fetch-Site": "cross-site"}, {"Sec-Fetch-Site": "same-site"}],
)  # fmt: skip
def test_page_of_another_site_changes_nothing_and_opens_no_websocket(header):
    async def script(found: Site) -> None:
        client = await found.client()
        token = (await (await client.get("/api/v1/session")).json())["csrf"]
        headers = header | {"X-CSRF-Token": token}
        async with client.post(SETPOINT, json={"value": 50}, headers=headers) as answer:
            assert answer.status == 403
        with pytest.raises(WSServerHandshakeError) as caught:
            await client.ws_connect("/api/v1/ws", headers=header)
        assert caught.value.status == 403
        assert not found.plant.written
        # Nothing allows another origin to read an answer.
        async with client.get("/api/v1/session", headers=header) as answer:
            assert not [name for name in answer.headers if name.startswith("Access-Control")]

    play(script)


@pytest.mark.parametrize(
    ("host", "is_known"),
    [
        ("127.0.0.1:8080", True),
        ("localhost", True),
        ("[::1]:80", True),
        ("10.1.2.3", True),
        ("panel.works.example:8080", True),
        ("PANEL.works.example.", True),
        ("evil.example", False),
        ("127.0.0.1.evil.example", False),
        ("panel.works.example.evil.example", False),
        ("", False),
        ("a b", False),
    ],
)
def test_host_header_is_an_address_or_a_known_name(host, is_known):
    async def script(found: Site) -> None:
        client = await found.client()
        async with client.get("/api/v1/session", headers={"Host": host}) as answer:
            assert (answer.status == 200) is is_known

    play(script, replace(OPEN, hosts=("panel.works.example",)))


def test_session_cookie_is_out_of_reach_of_scripts_and_other_sites():
    async def cookie(section: WebSection) -> str:
        async with site(section) as found:
            client = await found.client()
            body = {"user": "otto", "password": PASSWORD}
            async with client.post("/api/v1/login", json=body) as answer:
                return answer.headers["Set-Cookie"]

    plain = asyncio.run(cookie(CLOSED))
    assert "HttpOnly" in plain
    assert "SameSite=Strict" in plain
    assert "Secure" not in plain
    # The flag follows the key; the test server itself speaks no TLS.
    tls = WebTls(certificate="page.crt", key="page.key")
    assert "Secure" in asyncio.run(cookie(replace(CLOSED, tls=tls)))


def test_logout_ends_session_and_websockets():
    async def script(found: Site) -> None:
        browser, headers = await found.log_in("otto")
        token = next(iter(browser.session.cookie_jar)).value
        socket = await browser.ws_connect("/api/v1/ws")
        assert (await socket.receive_json())["user"] == "otto"
        async with browser.post("/api/v1/logout", json={}, headers=headers) as answer:
            assert answer.status == 200
        assert (await socket.receive()).type in {WSMsgType.CLOSE, WSMsgType.CLOSING}
        assert (await browser.get("/api/v1/status")).status == 401
        stolen = {"Cookie": f"{guard.COOKIE}={token}"}
        assert (await (await found.client()).get("/api/v1/status", headers=stolen)).status == 401

    play(script, CLOSED)


def test_wrong_passwords_lock_user_out_of_that_host():
    async def script(found: Site) -> None:
        client = await found.client()
        for _ in range(FREE_FAILURES):
            body = {"user": "otto", "password": "wrong"}
            async with client.post("/api/v1/login", json=body) as answer:
                assert answer.status == 401
        body["password"] = PASSWORD
        async with client.post("/api/v1/login", json=body) as answer:
            assert answer.status == 429
            assert 1 <= int(answer.headers["Retry-After"]) <= 30
        async with client.get("/api/v1/status", headers=basic("otto", PASSWORD)) as answer:
            assert answer.status == 429
        body["user"] = "elsa"
        async with client.post("/api/v1/login", json=body) as answer:
            assert answer.status == 200

    play(script, CLOSED)


@pytest.mark.parametrize(
    ("name", "password"), [("nobody", PASSWORD), ("otto", ""), ("otto", "x" * 1000), ("", "")]
)
def test_wrong_login_is_refused(name, password):
    async def script(found: Site) -> None:
        client = await found.client()
        body = {"user": name, "password": password}
        async with client.post("/api/v1/login", json=body) as answer:
            assert (answer.status, await reason(answer)) == (401, "unknown user or wrong password")
        async with client.post("/api/v1/login", json={"user": 1}) as answer:
            assert answer.status == 400

    play(script, CLOSED)


def test_program_authenticates_each_request_by_password():
    async def script(found: Site) -> None:
        client = await found.client()
        right, wrong = basic("otto", PASSWORD), basic("otto", "x")
        async with client.post(SETPOINT, json={"value": 60}, headers=right) as answer:
            assert answer.status == 200
        async with client.post(SETPOINT, json={"value": 61}, headers=wrong) as answer:
            assert answer.status == 401
        for given in ("Basic !!!", "Basic", "Bearer b3R0bzp4", "Basic /w=="):
            headers = {"Authorization": given}
            assert (await client.get("/api/v1/status", headers=headers)).status == 401
        assert [each["origin"].user for each in found.plant.written] == ["otto"]

    play(script, CLOSED)


def test_proxy_names_the_user_if_it_is_the_proxy():
    section = replace(CLOSED, proxy=WebProxy(header="X-Remote-User"))
    headers = {"X-Remote-User": "otto", "X-Forwarded-For": "1.1.1.1, 10.0.0.9"}

    async def script(found: Site) -> None:
        client = await found.client()
        async with client.post(SETPOINT, json={"value": 60}, headers=headers) as answer:
            assert answer.status == 200
        (written,) = found.plant.written
        assert (written["origin"].user, written["origin"].host) == ("otto", "10.0.0.9")
        headers["X-Remote-User"] = "nobody"
        assert (await client.get("/api/v1/status", headers=headers)).status == 403

    play(script, section)
    headers["X-Remote-User"] = "otto"

    async def from_elsewhere(found: Site) -> None:
        client = await found.client()
        assert (await client.get("/api/v1/status", headers=headers)).status == 403

    elsewhere = WebProxy(header="X-Remote-User", networks=("10.0.0.0/8",))
    play(from_elsewhere, replace(section, proxy=elsewhere))


def test_rate_of_a_host_is_limited(monkeypatch):
    monkeypatch.setattr(guard, "_RATE", (5, 0.001))

    async def script(found: Site) -> None:
        client = await found.client()
        statuses = [(await client.get("/api/v1/session")).status for _ in range(8)]
        assert statuses == [200] * 5 + [429] * 3

    play(script)


def test_browser_that_opens_many_tabs_gets_all_files():
    async def script(found: Site) -> None:
        client = await found.client()
        statuses = {(await client.get("/app.js")).status for _ in range(300)}
        assert statuses == {200}

    play(script)


def test_hosts_behind_a_proxy_have_rates_of_their_own(monkeypatch):
    monkeypatch.setattr(guard, "_RATE", (2, 0.001))

    async def script(found: Site) -> None:
        client = await found.client()
        statuses = [
            (await client.get("/api/v1/session", headers={"X-Forwarded-For": host})).status
            for host in ("10.0.0.1", "10.0.0.2", "10.0.0.1", "10.0.0.2", "10.0.0.1, 10.0.0.2")
        ]
        assert statuses == [200] * 4 + [429]

    play(script, replace(CLOSED, proxy=WebProxy(header="X-Remote-User")))
    with pytest.raises(AssertionError):  # without a proxy the header says nothing
        play(script, CLOSED)


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


async def subscribed(client, *topics: str):
    socket = await client.ws_connect("/api/v1/ws")
    welcome = await socket.receive_json()
    assert (welcome["type"], welcome["version"], welcome["plant"]) == ("welcome", 1, "line")
    await socket.send_json({"subscribe": topics})
    return socket


async def of_type(socket, kind: str) -> dict:
    while (message := await socket.receive_json())["type"] != kind:
        pass
    return message


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


def test_tables_are_sent_once_a_second():
    async def script(found: Site) -> None:
        client = await found.client()
        socket = await subscribed(client, "page:All")
        while (await of_type(socket, "values"))["values"]["mixer/speed"][0] != 50.5:
            pass
        topic = found.server.topics._topics["page:All"]
        assert (topic.names[100], len(topic.names[1000])) == ([], 3)

    play(script, WebSection(pages=(page(TablePanel(), name="All"),)))


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
