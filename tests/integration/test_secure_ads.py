"""Secure ADS between stations, by the commands of docs/secure-ads.md, and with foreign clients."""

from __future__ import annotations

import json
import re
import socket
import ssl
import struct
import subprocess
from pathlib import Path
from typing import Self

import pytest

from tests.support import aoe
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

PAGE = Path(__file__).parents[2] / "docs" / "secure-ads.md"
SAW = ("127.0.8.2", 8016)


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def folder(module_farm: Plants) -> Path:
    """The folder after the commands that make certificates."""
    self_signed, authority, *_ = blocks("sh")
    for commands in (self_signed, authority):
        shell(commands, module_farm.folder)
    return module_farm.folder


def shell(commands: str, folder: Path) -> str:
    done = subprocess.run(
        ["sh", "-e"], check=False, input=commands, capture_output=True, text=True, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def fingerprint(folder: Path, name: str) -> str:
    line = shell(f"openssl x509 -in {name}.crt -noout -fingerprint -sha256", folder)
    return line.strip().partition("=")[2]


@pytest.fixture(scope="module")
def plant(module_farm: Plants, folder: Path) -> Appliance:
    (text,) = blocks("yaml")
    (folder / "engineer.secret").write_text("timber\n")
    text = text.replace("FINGERPRINT OF SAW", fingerprint(folder, "saw"))
    text = text.replace("FINGERPRINT OF MILL", fingerprint(folder, "mill"))
    assert "FINGERPRINT" not in text
    return module_farm.run(module_farm.write(text, "timber.yaml"))


class TlsClient:
    """Speaks AMS without prefix by Python's own TLS."""

    def __init__(self, folder: Path, name: str, flags: int = 0, *, login: bytes = b"") -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False
        context.load_verify_locations(folder / "saw.crt")
        context.load_cert_chain(folder / f"{name}.crt", folder / f"{name}.key")
        self._plain = socket.create_connection(SAW, timeout=10)
        self.socket = context.wrap_socket(self._plain)
        user, _, password = login.partition(b":")
        length = 64 + len(user) + len(password)
        head = struct.pack("<HHBB6s", length, flags, 1, 0, bytes([10, 9, 9, 9, 1, 1]))
        head += struct.pack("<BB18x", len(user), len(password))
        self.socket.sendall(head + name.encode().ljust(32, b"\0") + user + password)
        self.response = self._exactly(64)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    @property
    def error(self) -> int:
        return self.response[5]

    def ask(self, command: int, body: bytes, *, port: int = aoe.DEVICE) -> tuple[int, bytes]:
        """Return the error in the AMS header and the data of an answer."""
        self.socket.sendall(aoe.packet("127.0.8.2.2.1", command, body, port=port))
        head = self._exactly(32)
        (length, error) = struct.unpack_from("<II", head, 20)
        return error, self._exactly(length)

    def write_speed(self, value: float) -> int:
        """Return the result of a write to the variable ``speed``."""
        name = b"speed\0"
        body = struct.pack("<IIII", 0xF003, 0, 4, len(name)) + name
        error, data = self.ask(9, body)
        assert error == 0
        assert struct.unpack_from("<II", data) == (0, 4)
        handle = data[8:12]
        error, data = self.ask(
            aoe.WRITE, struct.pack("<I4sI", 0xF005, handle, 4) + struct.pack("<f", value)
        )
        return error or struct.unpack("<I", data)[0]

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            more = self.socket.recv(size - len(data))
            assert more, f"closed after {len(data)} of {size} bytes"
            data += more
        return data


def test_stations_reach_each_other_by_tls(plant: Appliance) -> None:
    _, _, commands, _ = blocks("sh")
    _, listing, test = commands.splitlines()
    wait_until(lambda: "up" in plant.command(*listing.split()[1:]))
    assert re.search(r"mill +saw +127.0.8.2.\*.\* +ams-tls +127.0.8.2:8016 +up",
                     plant.command(*listing.split()[1:]))  # fmt: skip
    assert "answers: RUN" in plant.command(*test.split()[1:])
    assert "ams-tls:mill" in plant.command("routes", "list", "saw")


def test_openssl_completes_the_handshake(plant: Appliance, folder: Path) -> None:
    done = subprocess.run(
        ["sh", "-c", blocks("sh")[3]], check=False, capture_output=True, text=True, cwd=folder,
        timeout=30,
    )  # fmt: skip
    assert "CONNECTION ESTABLISHED" in done.stderr
    assert "Protocol version: TLSv1.2" in done.stderr


def test_rule_names_the_client_of_a_certificate(plant: Appliance, folder: Path) -> None:
    with TlsClient(folder, "panel") as client:
        assert client.error == 0
        assert client.write_speed(2.5) == 0
    wait_until(lambda: plant.values("saw")["speed"] == 2.5)
    with TlsClient(folder, "mill") as client:
        assert client.error == 0
        assert client.write_speed(7.0) == 0x723
    audit = folder / "state" / "timber" / "audit.jsonl"
    lines = [json.loads(line) for line in audit.read_text().splitlines()]
    told = [(each["transport"], each["allowed"]) for each in lines if "tls" in each["transport"]]
    assert told == [("ams-tls:panel", True), ("ams-tls:mill", False)]


def test_station_requests_a_route_from_the_other_router(plant: Appliance, folder: Path) -> None:
    """The plant file has the route already: the answer is the same."""
    words = ["routes", "add-remote", "mill", SAW[0], "--user", "engineer"]
    password = ["--password-file", str(folder / "engineer.secret")]
    right = ["--fingerprint", fingerprint(folder, "saw")]
    assert "added" in plant.command(*words, *password, *right)
    wrong = run_eapctl(
        plant.runtime, *words, *password, "--fingerprint", fingerprint(folder, "mill")
    )
    assert wrong.returncode == 1
    assert "its certificate has the fingerprint" in wrong.stdout
    without = run_eapctl(plant.runtime, *words, *password, "--tls")
    assert "station mill needs a fingerprint, or secure_ads with a ca" in without.stderr


def test_client_requests_a_route_and_is_known_until_it_is_removed(
    plant: Appliance, folder: Path
) -> None:
    shell(
        "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=tablet -keyout tablet.key"
        " -out tablet.crt", folder,
    )  # fmt: skip
    before = plant.station("saw")["discarded"].get("tls_fingerprint", 0)
    with TlsClient(folder, "tablet", 0x10) as client:
        assert client.error == 3
    with TlsClient(folder, "tablet", 0x90, login=b"engineer:wrong") as client:
        assert client.error == 4
    with TlsClient(folder, "tablet", 0x90, login=b"engineer:timber") as client:
        assert client.error == 0
        assert client.ask(aoe.READ_STATE, b"")[0] == 0
    with TlsClient(folder, "tablet", 0x10) as client:
        assert client.error == 0
    assert re.search(r"tablet +10.9.9.9.\*.\* +ams-tls", plant.command("routes", "list", "saw"))
    plant.command("routes", "remove", "saw", "tablet")
    with TlsClient(folder, "tablet", 0x10) as client:
        assert client.error == 3
    counted = plant.station("saw")["discarded"]
    assert counted["tls_fingerprint"] == before + 2
    assert counted["tls_user"] == 1
