"""Users, sessions, other sites, names and rates: what the page's server lets through."""

from __future__ import annotations

import asyncio

import pytest
from aiohttp import WSMsgType, WSServerHandshakeError
from msgspec.structs import replace

from eap.ams.spec import Role
from eap.config.web_sections import WebProxy, WebSection, WebTls
from eap.runtime.logins import FREE_FAILURES
from eap.web import guard
from tests.support.passwords import PASSWORD
from tests.support.webplant import (
    CLOSED,
    OPEN,
    SETPOINT,
    Site,
    basic,
    play,
    reason,
    site,
)

pytestmark = pytest.mark.net


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
