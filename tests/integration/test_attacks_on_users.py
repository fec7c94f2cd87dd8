"""Attacks on users of the hardened plant: by its page, by OPC UA, and on its own hosts.

The page docs/security.md lists each with its effect; what it says of an attack is tested here.
"""

from __future__ import annotations

import json
import re
import ssl
import subprocess
import threading
from base64 import b64encode
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from typing import Any

import pytest

from tests.support.appliance import wait_until
from tests.support.hardenedplant import (
    ATTACKER,
    ENGINEER,
    OTHER,
    OVEN,
    WEB,
    Site,
    hardened_plant,
)
from tests.support.namespaces import Namespace, enter

pytestmark = [pytest.mark.net, pytest.mark.root]

OPCUA = f"opc.tcp://{OVEN}:4840/"


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with hardened_plant() as found:
        yield found


def basic(user: str, password: str = "secret") -> str:
    return "Basic " + b64encode(f"{user}:{password}".encode()).decode()


# Page


def test_page_without_login_shows_nothing(site: Site) -> None:
    for path in ("/api/v1/status", "/api/v1/oven/ticks", "/api/v1/pages", "/metrics"):
        assert site.page("GET", path)[0] == 401


@pytest.mark.parametrize(
    "path",
    ["/../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "/%2e%2e/page.key", "/api/v1/pictures/..%2f"],
)
def test_path_traversal_of_the_page_finds_nothing(site: Site, path: str) -> None:
    assert site.page("GET", path, Authorization=basic("vera"))[0] in {400, 404}


def test_viewer_sets_nothing_and_operator_only_its_panel(site: Site) -> None:
    wait_until(
        lambda: site.page("GET", "/api/v1/oven/ticks", Authorization=basic("vera"))[0] == 200
    )
    for user, name, status in (
        ("vera", "setpoint", 403),
        ("otto", "limit", 403),
        ("otto", "setpoint", 200),
    ):
        path, login = f"/api/v1/oven/{name}", basic(user)
        assert site.page("POST", path, body={"value": 7}, Authorization=login)[0] == status
    values = site.oven.values("oven")
    assert (values["setpoint"], values["limit"]) == (7, 0)


def test_requests_of_other_sites_and_names_are_refused(site: Site) -> None:
    login = {"Authorization": basic("otto"), "Origin": "https://evil.example"}
    path = "/api/v1/oven/setpoint"
    assert site.page("POST", path, body={"value": 9}, **login)[0] == 403
    assert site.page("GET", "/api/v1/status", Host="evil.example")[0] == 403


def test_guessed_passwords_lock_the_host_out_and_are_seen(site: Site) -> None:
    name = "anna\n\x1b[31mforged line"
    answers = [
        site.page("POST", "/api/v1/login", OTHER, {"user": "anna", "password": str(guess)})[0]
        for guess in range(7)
    ]
    assert answers == [401] * 5 + [429] * 2
    right = {"user": "anna", "password": "secret"}
    assert site.page("POST", "/api/v1/login", OTHER, right)[0] == 429
    assert site.page("POST", "/api/v1/login", ENGINEER, right)[0] == 200
    site.page("POST", "/api/v1/login", OTHER, {"user": name, "password": "x"})
    wait_until(lambda: site.oven.status()["logins"].get("web", {}).get("locked", 0) >= 3)
    wait_until(lambda: any(each.get("user") == name for each in site.audit()))
    lines = [each for each in site.audit() if each.get("operation") == "login"]
    assert {(each["transport"], each["from"], each["allowed"]) for each in lines} == {
        ("web", OTHER, False)
    }
    shown = site.oven.command("status")
    assert "logins refused" in shown
    assert "\x1b[31m" not in shown
    counted = re.compile(r'eap_refused_logins_total\{.*transport="web",why="locked"\} [3-9]')
    vera = {"Authorization": basic("vera")}
    wait_until(lambda: counted.search(site.page("GET", "/metrics", ENGINEER, **vera)[1].decode()))


def test_flood_of_requests_to_the_page_is_refused_for_its_host_alone(site: Site) -> None:
    context = ssl.create_default_context(cafile=site.folder / "page.crt")
    context.check_hostname = False
    request = f"GET /api/v1/session HTTP/1.1\r\nHost: {OVEN}\r\n\r\n".encode()
    with context.wrap_socket(site.tcp(ATTACKER, WEB[1])) as sock:
        answers = b""
        for number in range(1, 11):  # 200 at once and 50 a second are answered
            sock.sendall(100 * request)
            while answers.count(b"HTTP/1.1 ") < 100 * number:
                answers += sock.recv(65536)
    assert answers.count(b"HTTP/1.1 429") > 0
    assert site.page("GET", "/api/v1/session", ENGINEER)[0] == 200


def test_half_open_tls_and_slow_readers_leave_the_page(site: Site) -> None:
    with ExitStack() as stack:
        for number in range(60):
            with suppress(OSError):
                sock = stack.enter_context(site.tcp(ATTACKER, WEB[1]))
                sock.sendall(b"\x16\x03\x01\x02\x00"[: number % 6])
        assert site.page("GET", "/api/v1/session", ENGINEER)[0] == 200


def test_page_takes_no_old_tls_and_no_clear_text(site: Site) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        context.maximum_version = ssl.TLSVersion.TLSv1_1
    with site.tcp(ATTACKER, WEB[1]) as sock, pytest.raises((ssl.SSLError, OSError)):
        context.wrap_socket(sock)
    with site.tcp(ATTACKER, WEB[1]) as sock:
        sock.sendall(b"GET /api/v1/session HTTP/1.1\r\nHost: x\r\n\r\n")
        assert b"HTTP/1.1 200" not in sock.recv(4096)


# OPC UA


def in_network(place: Namespace, work: Any) -> Any:
    """Return what *work* returns in a network."""
    found: list[Any] = []

    def run() -> None:
        enter(place)
        try:
            found.append(work())
        except Exception as exc:  # noqa: BLE001  handed to the test
            found.append(exc)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(60)
    return found[0]


def test_opcua_without_security_or_with_an_unknown_certificate_is_refused(site: Site) -> None:
    pytest.importorskip("asyncua", reason="needs asyncua: pip install asyncua")
    import asyncio

    from asyncua import Client, ua
    from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

    key, certificate = site.folder / "evil-key.pem", site.folder / "evil.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj",
         "/CN=evil", "-addext", "subjectAltName=URI:urn:evil", "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip

    async def log_in(*, secure: bool) -> object:
        client = Client(OPCUA, timeout=10)
        client.application_uri = "urn:evil"
        client.set_user("anna")
        client.set_password("secret")
        if secure:
            await client.set_security(SecurityPolicyBasic256Sha256, str(certificate), str(key))
        async with client:
            return "logged in"

    for secure in (False, True):
        found = in_network(site.there, lambda secure=secure: asyncio.run(log_in(secure=secure)))
        assert isinstance(found, (ua.UaError, OSError, TimeoutError)), found
    assert list((site.folder / "state-oven/hardened/opcua/rejected").iterdir())


# Users of this host

PROBE = """
import json, socket, sys
path, *requests = sys.argv[1:]
with socket.socket(socket.AF_UNIX) as sock:
    sock.settimeout(10)
    sock.connect(path)
    reader = sock.makefile("rb")
    for request in requests:
        try:
            sock.sendall(request.encode() + b"\\n")
        except OSError:
            pass
        print(reader.readline().decode().strip() or "{}")
"""


def as_user(site: Site, uid: int, *requests: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the answers of the control socket to a user of this host."""
    lines = [json.dumps({"v": 1, "id": 1} | each) for each in requests]
    path = str(site.oven.runtime / "hardened@oven" / "control")
    done = subprocess.run(
        ["setpriv", f"--reuid={uid}", f"--regid={uid}", "--clear-groups",
         "/usr/bin/python3", "-c", PROBE, path, *lines],
        capture_output=True, text=True, check=False, cwd="/",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def writing(name: str, **more: Any) -> dict[str, Any]:
    params = {"station": "oven", "values": {name: 11}} | more
    return {"method": "write", "params": params}


@pytest.mark.host_root
def test_other_users_of_the_host_do_what_their_role_allows(site: Site) -> None:
    (refused,) = as_user(site, 64_951, {"method": "status"})
    assert refused["error"]["message"] == "user 64951 of this host has no role in the plant file"
    read, outside, stop, forged, done = as_user(
        site,
        65534,  # otto
        {"method": "read", "params": {"station": "oven"}},
        writing("limit"),
        {"method": "stop"},
        writing("setpoint", origin={"user": "anna", "host": ENGINEER}),
        writing("setpoint"),
    )
    assert ("result" in read, "result" in done) == (True, True)
    assert "set by engineers only" in outside["error"]["message"]
    assert "otto is operator, and stop needs engineer" in stop["error"]["message"]
    assert "only programs of the appliance's user act for" in forged["error"]["message"]
    (done,) = as_user(site, 1, writing("limit"))  # anna
    assert "result" in done
    lines = [each for each in site.audit() if each["transport"] == "control"]
    assert {each.get("user") for each in lines} >= {"otto", "anna"}
    assert [each["operation"] for each in lines if each.get("error")].count("stop") == 1


CROWD = """
import socket, sys
held = []
for _ in range(100):
    held.append(socket.socket(socket.AF_UNIX))
    held[-1].connect(sys.argv[1])
print("held", flush=True)
sys.stdin.read()
"""


@pytest.mark.host_root
def test_connections_of_other_users_leave_places_for_the_operator(site: Site) -> None:
    path = str(site.oven.runtime / "hardened@oven" / "control")
    with subprocess.Popen(
        ["setpriv", "--reuid=64951", "--regid=64951", "--clear-groups",
         "/usr/bin/python3", "-c", CROWD, path],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd="/",
    ) as crowd:  # fmt: skip
        assert crowd.stdout is not None
        assert crowd.stdout.readline() == "held\n"
        assert site.oven.station("oven")["state"] == "OP"
        assert crowd.stdin is not None
        crowd.stdin.close()


@pytest.mark.host_root
def test_other_users_of_the_host_read_no_files(site: Site) -> None:
    folder = site.oven.runtime / "hardened@oven"
    paths = [folder / name for name in ("oven.image", "lock", "opcua.bridge")]
    paths += [site.folder / name for name in ("plant.keys", "page.key", "state-oven")]
    words = "import os,sys\nprint([os.access(p, os.R_OK) for p in sys.argv[1:]])"
    done = subprocess.run(
        ["setpriv", "--reuid=64951", "--regid=64951", "--clear-groups",
         "/usr/bin/python3", "-c", words, *paths],
        capture_output=True, text=True, check=True, cwd="/",
    )  # fmt: skip
    assert all(path.exists() for path in paths)
    assert done.stdout.strip() == str([False] * len(paths))
