"""A real broker: mosquitto on an address of loopback, with nothing kept on disk."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

SEARCH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


def mosquitto(program: str = "mosquitto") -> str | None:
    """Return where a program of the broker is, if it is installed."""
    return shutil.which(program, path=SEARCH)


class Broker:
    """One broker; it can be stopped and started again, and forgets everything in between.

    Args:
        folder: For its files.
        address: To listen on.
        settings: Lines of its configuration; without any, it lets everybody in.
        prefix: Words that start it somewhere else.
    """

    def __init__(
        self, folder: Path, address: str, *settings: str,
        port: int = 1883, prefix: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self.log = folder / "mosquitto.log"
        self._prefix = prefix
        self._process: subprocess.Popen[bytes] | None = None
        self._config = folder / "mosquitto.conf"
        lines = [f"listener {port} {address}", "persistence false", "user root", "log_type all",
                 *(settings or ("allow_anonymous true",))]  # fmt: skip
        self._config.write_text("\n".join(lines) + "\n")

    @property
    def pid(self) -> int:
        """Process id, 0 while it does not run."""
        return 0 if self._process is None else self._process.pid

    def start(self) -> None:
        """Start it and wait until it listens."""
        program = mosquitto()
        assert program is not None, "mosquitto is not installed"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [*self._prefix, program, "-c", str(self._config)], stdout=log, stderr=log
            )
        limit = time.monotonic() + 10
        while not re.search("mosquitto version .* running", text := self.log.read_text()):
            assert self._process.poll() is None, text
            assert time.monotonic() < limit, text
            time.sleep(0.02)

    def stop(self) -> None:
        """Kill it: what it would still like to say is not said."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(10)
            self._process = None


@contextmanager
def broker(
    folder: Path, address: str, *settings: str, port: int = 1883, prefix: Sequence[str] = ()
) -> Iterator[Broker]:
    """Run a broker."""
    folder.mkdir(parents=True, exist_ok=True)
    made = Broker(folder, address, *settings, port=port, prefix=prefix)
    made.start()
    try:
        yield made
    finally:
        made.stop()


def write_passwords(folder: Path, **users: str) -> Path:
    """Return a file of the broker's with users and their passwords."""
    program = mosquitto("mosquitto_passwd")
    assert program is not None
    file = folder / "passwords"
    file.touch(mode=0o600)
    for user, password in users.items():
        subprocess.run([program, "-b", str(file), user, password], check=True, capture_output=True)
    return file


def write_certificates(folder: Path, address: str) -> dict[str, Path]:
    """Return a CA, a certificate of the broker at *address* and one of a client, each with key."""
    files = {name: folder / f"{name}.pem" for name in ("ca", "broker", "client")}
    _openssl("req", "-x509", *_key(folder, "ca"), "-subj", "/CN=Test CA", "-out", files["ca"])
    for name, subject, more in (
        ("broker", "/CN=broker", ["-addext", f"subjectAltName=IP:{address}"]),
        ("client", "/CN=island-01", []),
    ):
        _openssl(
            "req", "-x509", *_key(folder, name), "-subj", subject, *more, "-out", files[name],
            "-CA", files["ca"], "-CAkey", folder / "ca.key",
            "-addext", "basicConstraints=critical,CA:FALSE",
        )  # fmt: skip
        files[f"{name}_key"] = folder / f"{name}.key"
    return files


def _key(folder: Path, name: str) -> list[object]:
    return ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
            "-keyout", folder / f"{name}.key"]  # fmt: skip


def _openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)
