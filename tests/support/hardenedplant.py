"""The hardened plant of docs/security.md on two hosts, in a network with attackers."""

from __future__ import annotations

import http.client
import json
import pwd
import re
import shutil
import socket
import ssl
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, plants, run_eapctl, wait_until
from tests.support.namespaces import Namespace, cable
from tests.support.pages import ROOT
from tests.support.passwords import SECRET_HASH

PAGE = (ROOT / "docs/security.md").read_text()
NET = "10.88.164"
OVEN, PANEL, ATTACKER, OTHER, ENGINEER = (f"{NET}.{number}" for number in (1, 2, 3, 4, 7))
OVEN_ID, PANEL_ID, BUS_ID = f"{OVEN}.2.1", f"{PANEL}.2.1", f"{OVEN}.3.1"
WEB = (OVEN, 8443)

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


@contextmanager
def hardened_plant() -> Iterator[Site]:
    """Start the plant, and wait until its bridges and its page run."""
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
