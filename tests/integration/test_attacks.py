"""Attacks on the hardened plant of docs/security.md, one by one, from hosts of its network.

The page lists each of them with its effect; what it says of an attack is what is tested here.
"""

from __future__ import annotations

import http.client
import json
import os
import pwd
import re
import shutil
import socket
import ssl
import struct
import subprocess
import threading
from base64 import b64encode
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

import pytest

from eap.codec.ads import IndexGroup
from eap.codec.ams import CONTROL_PORT
from eap.config.pd_keys import read_keys
from eap.pd.authentication import SIGNATURE_ID, SIGNATURE_SIZE, KeyRing
from eap.pd.link import OutFrame
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, plants, run_eapctl, wait_until
from tests.support.cyclic import octets
from tests.support.namespaces import Namespace, cable, enter
from tests.support.passwords import SECRET_HASH
from tests.support.vectors import load

pytestmark = [pytest.mark.net, pytest.mark.root]

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/security.md").read_text()
NET = "10.88.164"
OVEN, PANEL, ATTACKER, OTHER, ENGINEER = (f"{NET}.{number}" for number in (1, 2, 3, 4, 7))
OVEN_ID, PANEL_ID, BUS_ID = f"{OVEN}.2.1", f"{PANEL}.2.1", f"{OVEN}.3.1"
WEB, OPCUA = (OVEN, 8443), f"opc.tcp://{OVEN}:4840/"
DENIED = 0x723
(ADD_ROUTE, SERVER_INFO) = (vector.octets for vector in load("ams_discovery"))


CERTIFICATES = """exec 2>/dev/null
own() {
    openssl req -x509 -newkey rsa:2048 -nodes -days 2 -subj "/CN=$2" -keyout $1.key -out $1.crt
}
signed() {
    openssl req -newkey rsa:2048 -nodes -subj /CN=$2 -keyout $1.key -out $1.csr
    openssl x509 -req -in $1.csr -CA $3.crt -CAkey $3.key -CAcreateserial -days 2 -out $1.crt
}
own works 'works CA'
signed oven oven works
signed anna anna works
own evil anna
own other 'other CA'
signed rogue anna other
"""


class SecureClient:
    """Speaks ADS over TLS with the certificate *name*."""

    def __init__(self, plain: socket.socket, folder: Path, name: str, flags: int = 0) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.load_verify_locations(folder / "works.crt")
        if name:
            context.load_cert_chain(folder / f"{name}.crt", folder / f"{name}.key")
        self._socket = context.wrap_socket(plain)
        head = struct.pack("<HHBB6s20x", 64, flags, 1, 0, bytes([10, 9, 9, 9, 1, 1]))
        self._socket.sendall(head + b"attack".ljust(32, b"\0"))
        self.error = self._exactly(64)[5]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def ask(
        self, target: str, command: int, body: bytes, *, port: int = aoe.DEVICE
    ) -> tuple[int, bytes]:
        """Return the error in the AMS header and the data of an answer."""
        self._socket.sendall(aoe.packet(target, command, body, port=port))
        head = self._exactly(32)
        length, error = struct.unpack_from("<II", head, 20)
        return error, self._exactly(length)

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            if not (more := self._socket.recv(size - len(data))):
                raise ConnectionError(f"closed after {len(data)} of {size} bytes")
            data += more
        return data


class Site(NamedTuple):
    """The plant on two hosts, and the network of the attackers, in which the panel is, too.

    Attributes:
        oven: Appliance of the attacked host.
        panel: That of the other one.
        here: Network of the attacked host.
        there: The other end of its cable, with the addresses of all other hosts.
        folder: With the plant file and its keys.
    """

    oven: Appliance
    panel: Appliance
    here: Namespace
    there: Namespace
    folder: Path

    def audit(self) -> list[dict[str, Any]]:
        lines = (self.folder / "state-oven" / "hardened" / "audit.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]

    def discarded(self) -> dict[str, int]:
        found: dict[str, int] = self.oven.rx("oven", "panel")["discarded"]
        return found

    def udp(self, source: str, port: int = 0) -> socket.socket:
        sock = self.there.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.bind((source, port))
        sock.settimeout(0.5)
        return sock

    def tcp(self, source: str, port: int) -> socket.socket:
        sock = self.there.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.bind((source, 0))
        sock.settimeout(10)
        sock.connect((OVEN, port))
        return sock

    def ams(self, source: str) -> AmsClient:
        sock = self.there.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.bind((source, 0))
        return AmsClient(OVEN, sock)

    def engineer(self) -> SecureClient:
        """Return a client with the certificate of the engineer."""
        return SecureClient(self.tcp(ENGINEER, 8016), self.folder, "anna")

    def page(
        self, method: str, path: str, source: str = ATTACKER, body: object = None, **headers: str
    ) -> tuple[int, Any]:
        """Return status and document of a request to the page."""
        context = ssl.create_default_context(cafile=self.folder / "page.crt")
        context.check_hostname = False
        connection = http.client.HTTPSConnection(*WEB)
        connection.sock = context.wrap_socket(self.tcp(source, WEB[1]))
        data = None if body is None else json.dumps(body)
        with connection.sock:
            given = {"Content-Type": "application/json"} if data else {}
            connection.request(method, path, data, given | headers)
            answer = connection.getresponse()
            text = answer.read()
        with suppress(ValueError):
            return answer.status, json.loads(text)
        return answer.status, text

    def goes_on(self) -> None:
        """Check that fresh process data arrives and no signature of it is refused."""
        received = self.oven.rx("oven", "panel")["received"]
        wait_until(lambda: self.oven.rx("oven", "panel")["received"] > received + 10)


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with plants() as farm, cable(addresses=True) as (here, there):
        for address in (ATTACKER, OTHER, ENGINEER):
            there.ip("addr", "add", f"{address}/24", "dev", "line0")
        yield _start(farm, here, there)


def _start(farm: Plants, here: Namespace, there: Namespace) -> Site:
    folder = farm.folder
    folder.chmod(0o711)  # users of this host reach the control socket
    (text,) = re.findall(r"```yaml\n(plant: hardened\n.*?)```", PAGE, re.DOTALL)
    accounts = {"anna": pwd.getpwuid(1).pw_name, "otto": pwd.getpwuid(65534).pw_name}
    for name, account in accounts.items():
        text = text.replace(f"unix: [{name}]", f"unix: [{account}]")
    text = text.replace("scrypt$…", SECRET_HASH).replace("10.0.0.", f"{NET}.")
    plant = farm.write(text, "hardened.yaml")
    shutil.copy(ROOT / "config/buses/drive.yaml", folder)
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=page", "-addext", f"subjectAltName=IP:{OVEN}",
         "-keyout", folder / "page.key", "-out", folder / "page.crt"],
        check=True, capture_output=True,
    )  # fmt: skip
    subprocess.run(["sh", "-e"], input=CERTIFICATES, text=True, check=True, cwd=folder)
    run_eapctl(folder, "keys", "new", str(folder / "plant.keys"))
    checked = run_eapctl(folder, "check", "--security", str(plant))
    assert (checked.returncode, "open" in checked.stdout + checked.stderr) == (0, False)
    running = []
    for name, place in (("oven", here), ("panel", there)):
        farm.state = folder / f"state-{name}"
        running.append(farm.start(plant, prefix=place.prefix))
    for each in running:
        each.wait_ready()
    site = Site(*running, here, there, folder)
    wait_until(lambda: all(b.get("is_up", True) for b in _bridges(site)) and _page_runs(site))
    site.goes_on()
    return site


def _bridges(site: Site) -> list[dict[str, Any]]:
    return [site.oven.status()["processes"]["opcua"].get("bridge", {"is_up": False})]


def _page_runs(site: Site) -> bool:
    page = site.oven.status()["processes"]["web"]
    return bool(page["pid"]) and "step" not in page


def basic(user: str, password: str = "secret") -> str:
    return "Basic " + b64encode(f"{user}:{password}".encode()).decode()


# Process data


def test_frames_of_a_forged_publisher_are_dropped_by_their_address(site: Site) -> None:
    before = site.discarded().get("wrong_source", 0)
    with site.udp(ATTACKER) as sock:
        sock.sendto(octets([(2, b"\xff" * 4)], publisher=PANEL_ID), (OVEN, 34980))
        wait_until(lambda: site.discarded().get("wrong_source", 0) > before)
    assert site.oven.rx("oven", "panel")["wrong_source"]["address"] == ATTACKER
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert ATTACKER in site.oven.command("status", "--full")


def signed(site: Site, at_ns: int) -> bytearray:
    """Return a frame of the panel with a right signature."""
    blank = octets([(2, b"\xff" * 4), (SIGNATURE_ID, bytes(SIGNATURE_SIZE), 1)], publisher=PANEL_ID)
    frame = OutFrame(bytearray(blank), 0, "", len(blank) - SIGNATURE_SIZE)
    KeyRing(read_keys(site.folder / "plant.keys")).sign(frame, at_ns)
    return frame.buffer


def test_frames_with_a_forged_address_are_dropped_by_their_signature(site: Site) -> None:
    recorded = signed(site, 1)
    changed = bytearray(recorded)
    changed[20] ^= 1
    before = site.discarded()
    with site.udp(PANEL) as sock:
        for data in (octets([(2, b"\xff" * 4)], publisher=PANEL_ID), changed, recorded):
            sock.sendto(data, (OVEN, 34980))
    reasons = ("unsigned", "bad_tag", "replayed")
    expected = {why: before.get(why, 0) + 1 for why in reasons}
    wait_until(lambda: {why: site.discarded().get(why, 0) for why in reasons} == expected)
    site.goes_on()
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert "not authentic" in site.oven.command("status", "--full")


def test_flood_of_frames_leaves_values_and_cycles(site: Site) -> None:
    junk = octets([(2, b"\xff" * 4)], publisher=PANEL_ID)
    with site.udp(ATTACKER) as sock:
        for number in range(20_000):
            sock.sendto(junk if number % 2 else os.urandom(60), (OVEN, 34980))
    site.goes_on()
    assert site.oven.rx("oven", "panel")["state"] == "running"
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert site.oven.station("oven")["discarded"]


def test_cut_line_ages_the_values_and_is_counted(site: Site) -> None:
    before = site.oven.rx("oven", "panel")["timeouts"]
    site.there.unplug()
    try:
        wait_until(lambda: site.oven.rx("oven", "panel")["timeouts"] > before)
        assert site.oven.request("read", station="oven")["stale"] == ["panel.level"]
    finally:
        site.there.plug()
    site.goes_on()


# ADS


def write(client: AmsClient | SecureClient, target: str = OVEN_ID, port: int = aoe.DEVICE) -> int:
    """Return the error or result of a write of an object."""
    error, data = client.ask(target, aoe.WRITE, aoe.write_body(0x8000_0001, b"\1\0"), port=port)
    return error or int.from_bytes(data[:4], "little")


def test_foreign_hosts_neither_write_nor_read(site: Site) -> None:
    with site.ams(ATTACKER) as client:
        assert write(client) == DENIED
        assert write(client, BUS_ID, 1001) == DENIED
        error, data = client.ask(OVEN_ID, aoe.READ, aoe.read_body(0x1018_0001, 4))
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
        error, data = client.ask(OVEN_ID, aoe.READ_STATE, b"")
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
    line = next(each for each in site.audit() if each["from"].startswith(ATTACKER))
    assert (line["allowed"], line["why"]) == (False, "rule rest refuses it")


def test_forged_net_id_of_an_engineer_changes_nothing(site: Site) -> None:
    """A source NetID proves nothing: the packet names the engineer's computer."""
    body = aoe.write_body(0x8000_0001, b"\1\0")
    packet = bytearray(aoe.packet(OVEN_ID, aoe.WRITE, body))
    packet[8:14] = aoe.net_id(f"{ENGINEER}.1.1")
    with site.ams(ATTACKER) as client:
        client._number = 1
        client.send(bytes(packet))
        error, data = client.receive()
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
    with site.udp(ATTACKER) as sock:
        sock.sendto(aoe.frame(bytes(packet)), (OVEN, 34980))
        answer = aoe.answer(sock.recv(2048))
        assert (answer.error or int.from_bytes(answer.data[:4], "little")) == DENIED


def test_datagrams_with_the_address_of_the_engineer_change_nothing(site: Site) -> None:
    """Blind writes: the attacker needs no answers, so nothing else would stop it."""
    frame = aoe.frame(aoe.packet(OVEN_ID, aoe.WRITE, aoe.write_body(0x8000_0001, b"\1\0")))
    with site.udp(ENGINEER) as sock:
        sock.sendto(frame, (OVEN, 34980))
        answer = aoe.answer(sock.recv(2048))
    assert (answer.error or int.from_bytes(answer.data[:4], "little")) == DENIED
    assert site.audit()[-1]["transport"] == "udp:eap0"


def test_host_with_a_known_address_reads_and_does_no_more(site: Site) -> None:
    with site.ams(PANEL) as client:
        error, data = client.ask(OVEN_ID, aoe.READ, aoe.read_body(0x1018_0001, 4))
        assert (error, data[:4]) == (0, bytes(4))
        assert write(client) == DENIED


def test_engineer_is_known_by_the_certificate_and_not_by_the_address(site: Site) -> None:
    with site.ams(ENGINEER) as client:
        assert write(client, BUS_ID, 1001) == DENIED
    with site.engineer() as client:
        assert client.error == 0
        assert write(client, BUS_ID, 1001) != DENIED
    line = site.audit()[-1]
    assert (line["transport"], line["why"]) == ("ams-tls:anna", "rule engineers allows it")


@pytest.mark.parametrize(
    ("name", "flags", "counter"),
    [
        ("", 0, "tls_certificate"),
        ("rogue", 0, "tls_certificate"),
        ("evil", 0x10, "tls_fingerprint"),
    ],
)
def test_secure_ads_refuses_others(site: Site, name: str, flags: int, counter: str) -> None:
    before = site.oven.station("oven")["discarded"].get(counter, 0)
    with suppress(OSError), SecureClient(site.tcp(ATTACKER, 8016), site.folder, name, flags) as one:
        assert one.error != 0
        one.ask(OVEN_ID, aoe.READ_STATE, b"")
        raise AssertionError("answered")
    wait_until(lambda: site.oven.station("oven")["discarded"].get(counter, 0) > before)


def test_flood_of_connections_leaves_room_for_others(site: Site) -> None:
    with ExitStack() as stack:
        for _ in range(60):
            with suppress(OSError):
                stack.enter_context(site.tcp(ATTACKER, 48898))
        with site.ams(PANEL) as client:
            assert client.ask(OVEN_ID, aoe.READ_STATE, b"")[0] == 0
        (listener,) = (
            each for each in site.oven.status()["listeners"] if each["name"].startswith("ams-tcp")
        )
        assert listener["refused"] + listener["evicted"] > 0
        assert listener["open"] <= 40


def test_add_route_is_refused_audited_and_its_flood_unanswered(site: Site) -> None:
    before = site.oven.station("oven")["discarded"].get("ams_discovery", 0)
    answers, lines = 0, len(site.audit())
    with site.udp(OTHER) as sock:
        for _ in range(200):
            sock.sendto(ADD_ROUTE, (OVEN, 48899))
        with suppress(TimeoutError):
            while True:
                assert b"\x04\x07\x00\x00" in sock.recv(400)  # refused
                answers += 1
    assert 1 <= answers < 30
    wait_until(lambda: site.oven.station("oven")["discarded"]["ams_discovery"] > before + 100)
    denied = site.audit()[lines:]
    assert not any(line["allowed"] for line in denied)
    assert any("only this host may add routes" in line["why"] for line in denied)
    (row,) = json.loads(site.oven.command("routes", "list", "oven", "--json"))["stations"]
    assert "added" not in {route["origin"] for route in row["routes"]}


def test_discovery_does_not_amplify(site: Site) -> None:
    with site.udp(ATTACKER) as sock:
        sock.sendto(SERVER_INFO, (OVEN, 48899))
        assert len(sock.recv(400)) < 3 * len(SERVER_INFO)


def test_configuration_and_control_protocol_are_closed_to_others(site: Site) -> None:
    """Groups CONTROL and CONFIGURE of the control protocol by ADS."""
    request = json.dumps({"v": 1, "method": "status"}).encode()
    for group in (IndexGroup.CONTROL, IndexGroup.CONFIGURE):
        body = struct.pack("<IIII", group, 0, 4096, len(request)) + request
        with site.ams(ATTACKER) as client:
            error, data = client.ask(f"{OVEN}.1.1", 9, body, port=CONTROL_PORT)
            assert error or int.from_bytes(data[:4], "little")


def test_answers_to_a_forged_address_are_hardly_longer_than_the_request(site: Site) -> None:
    """Reads in the name of another host, which gets the answers."""
    body = aoe.read_body(0x1018_0100, 0xFFFF)
    frame = aoe.frame(aoe.packet(OVEN_ID, aoe.READ, body))
    with site.udp(PANEL) as sock:
        sock.sendto(frame, (OVEN, 34980))
        received = [sock.recv(2048)]
        with suppress(TimeoutError):
            while True:
                received.append(sock.recv(2048))
    assert sum(map(len, received)) < 4 * len(frame)


# Mailbox gateway


def test_flood_of_the_gateway_is_denied_and_audited_within_limits(site: Site) -> None:
    lines = len(site.audit())
    read = struct.pack("<HHBB", 10, 1001, 0, 0x13) + bytes.fromhex("0020 40 18 10 01 00000000")
    frame = struct.pack("<H", len(read) | 5 << 12) + read
    with site.udp(ATTACKER) as sock:
        for _ in range(3000):
            sock.sendto(frame, (OVEN, 34980))
        assert sock.recv(2048)[10:11] == b"\x80"  # abort
    with site.engineer() as client:
        error, data = client.ask(BUS_ID, aoe.READ, aoe.read_body(0x1018_0001, 4), port=1001)
        assert (error, data[:4]) == (0, bytes(4))
    assert 0 < len(site.audit()) - lines < 1200
    site.goes_on()


@pytest.mark.parametrize("name", ["../../../etc/passwd", "/etc/passwd", "..\\\\plant.keys"])
def test_path_traversal_by_foe_finds_nothing(site: Site, name: str) -> None:
    """Even an engineer reaches the files of the slave only."""
    data = name.encode()
    body = struct.pack("<IIII", IndexGroup.FOE_OPEN_READ, 0, 4, len(data)) + data
    with site.engineer() as client:
        error, answer = client.ask(BUS_ID, 9, body, port=1001)
    assert error or int.from_bytes(answer[:4], "little")


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
from tests.support.passwords import SECRET_HASH
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


# Files

LAUGHS = "\n".join(
    ['<?xml version="1.0"?>', "<!DOCTYPE l [", '<!ENTITY a0 "ha">']
    + [f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 10)]
    + ["]>", "<EtherCATConfig>&a9;</EtherCATConfig>"]
)
OUTSIDE = (
    '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    "<EtherCATConfig>&x;</EtherCATConfig>"
)


@pytest.mark.parametrize("text", [LAUGHS, OUTSIDE, "<a>" * 100_000])
def test_hostile_import_files_are_findings(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bomb.xml"
    file.write_text(text)
    done = run_eapctl(tmp_path, "import", str(file), "--output-file", str(tmp_path / "plant.yaml"))
    assert done.returncode == 2
    assert "bomb.xml" in done.stderr
    assert "root:" not in done.stdout + done.stderr
    assert not (tmp_path / "plant.yaml").exists()


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*{'a' if not n else f'b{n - 1}'}"
        f", *{'a' if not n else f'b{n - 1}'}]\n" for n in range(40)),
        "[" * 100_000,
        "plant: !!python/object/apply:os.system [id]\nstations: []\n",
    ],
)  # fmt: skip
def test_hostile_plant_files_are_findings(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bomb.yaml"
    file.write_text(text)
    done = run_eapctl(tmp_path, "check", str(file))
    assert done.returncode == 2
    assert "bomb.yaml" in done.stderr
    assert "uid=" not in done.stdout + done.stderr
