"""A PostgreSQL server of Debian in a folder of the test."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

_BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
_USER = "nobody"


def _program(name: str) -> str:
    found = shutil.which(name) or next(
        (str(each / name) for each in reversed(_BINARIES) if (each / name).exists()), None
    )
    if found is None:
        pytest.skip(f"needs PostgreSQL: {name} is not installed")
    return found


class PostgresServer:
    """One server on 127.0.0.1, which starts and stops; it refuses to run as root."""

    def __init__(self, folder: Path) -> None:
        self._data = folder / "data"
        self._log = folder / "log"
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            self.port = sock.getsockname()[1]
        self._prefix: list[str] = []
        if os.geteuid() == 0:
            user = pwd.getpwnam(_USER)
            os.chown(folder, user.pw_uid, user.pw_gid)
            setpriv = shutil.which("setpriv")
            if setpriv is None:
                pytest.skip("needs setpriv: PostgreSQL does not run as root")
            self._prefix = [
                setpriv, "--reuid", str(user.pw_uid), "--regid", str(user.pw_gid), "--clear-groups",
            ]  # fmt: skip
        self._run("initdb", "-U", "eap", "-A", "trust", "-E", "UTF8", "--no-sync")

    @property
    def url(self) -> str:
        return f"postgresql://eap@127.0.0.1:{self.port}/postgres"

    def start(self) -> None:
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories=''"
        self._run("pg_ctl", "start", "-w", "-l", str(self._log), "-o", f"{options} -c fsync=off")

    def stop(self) -> None:
        self._run("pg_ctl", "stop", "-m", "immediate")

    def _run(self, program: str, *words: str) -> None:
        command = [*self._prefix, _program(program), "-D", str(self._data), *words]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, cwd="/", stdin=subprocess.DEVNULL
        )
        assert done.returncode == 0, done.stdout + done.stderr


@contextmanager
def postgres(folder: Path) -> Iterator[PostgresServer]:
    """Run a server."""
    server = PostgresServer(folder)
    server.start()
    try:
        yield server
    finally:
        server.stop()
