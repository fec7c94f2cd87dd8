"""Modules that an operation of the running demo plant passes.

A plant of the checkout runs with ``tracer/sitecustomize.py`` in its processes.  The operation is
repeated, the plant is left alone for as long, and the operation is repeated again.  On the path is
each module of the project with a function that is called once an operation, and hardly ever
without; of processes that only live for the operation, such as ``eapctl``, each module with a
function that is called at all.  Code that runs because a module is imported counts nowhere, and the
simulated slave is not on the path.  A busy machine adds a few modules by chance.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from tools.structure.counts import PACKAGES, Row

Calls: TypeAlias = Counter[tuple[str, str]]
"""Calls of each function: file and name."""

READS = 50
SETS = 5
_NEARLY_ALWAYS, _HARDLY_EVER = 0.8, 0.2
_TIMEOUT_S = 60
_TRACED = re.compile(rb"eap\.(engine|services)\.process")
_BUS, _ADDRESS = bytes((127, 0, 1, 1, 3, 1)), "127.0.1.1"
"""The first bus of ``config/demo.yaml``, and the address of its station."""


def trace_paths(root: Path) -> list[Row]:
    """Run the demo plant of the checkout in *root*; return the length of its paths."""
    with tempfile.TemporaryDirectory(prefix="structure-") as folder, _run(root, folder) as plant:
        with socket.create_connection((_ADDRESS, 48898), timeout=_TIMEOUT_S) as connection:
            sdo = plant.trace(lambda: _read_sdo(connection), READS)
        pd_set = plant.trace(plant.set_value, SETS)
    return [
        Row("modules from AMS/TCP to a slave's SDO", f"{len(sdo)}", sdo),
        Row("modules of pd set", f"{len(pd_set)}", pd_set),
    ]


class _Plant:
    """The running demo plant."""

    def __init__(self, root: Path, folder: Path) -> None:
        self._root = root
        self._folder = folder
        self._pids: list[int] = []
        self.environment = {
            **os.environ,
            "EAP_RUNTIME_DIR": str(folder),
            "EAP_STATE_DIR": str(folder / "state"),
            "PYTHONPATH": f"{Path(__file__).parent / 'tracer'}:{root}",
            "STRUCTURE_ROOT": str(root),
            "STRUCTURE_TRACE": str(folder / "trace"),
        }

    def find_processes(self, supervisor: int) -> None:
        """Remember the engine and services.

        The page's server may not have loaded the tracer yet: a signal would end it.
        """
        path = Path(f"/proc/{supervisor}/task/{supervisor}/children")
        children = map(int, path.read_text().split())
        self._pids = [pid for pid in children if _TRACED.search(_command_line(pid))]

    def set_value(self) -> None:
        """Run ``eapctl pd set`` to its end."""
        command = [sys.executable, "-m", "eap", "pd", "set", "island-01", "setpoint", "75"]
        environment = self.environment | {"STRUCTURE_FROM_START": "1"}
        subprocess.run(
            command, cwd=self._root, env=environment, check=True, stdout=subprocess.DEVNULL
        )

    def trace(self, operation: Callable[[], None], times: int) -> list[str]:
        """Return the modules that *operation* passes."""

        def repeat() -> None:
            for _ in range(times):
                operation()

        operation()  # what only the first one does is not on the path
        self._clear()
        begin = time.monotonic()
        busy, short_lived = self._record(repeat)
        taken_s = time.monotonic() - begin
        idle, _ = self._record(lambda: time.sleep(taken_s))  # noqa: TID251  it measures
        again, _ = self._record(repeat)  # what happened once by chance is not on the path
        common = [first & second for first, second in zip(busy, again, strict=True)]
        return find_passed(common, idle, short_lived, times)

    def _record(self, work: Callable[[], object]) -> tuple[list[Calls], list[Calls]]:
        """Return what the plant's processes and others call meanwhile."""
        for pid in self._pids:
            os.kill(pid, signal.SIGUSR1)
        work()
        for pid in self._pids:
            os.kill(pid, signal.SIGUSR2)
        _wait(lambda: all(self._trace_of(pid).exists() for pid in self._pids))
        plant = [read_calls(self._trace_of(pid)) for pid in self._pids]
        own = {self._trace_of(pid) for pid in self._pids}
        others = [read_calls(path) for path in self._traces() if path not in own]
        self._clear()
        return plant, others

    def _trace_of(self, pid: int) -> Path:
        return self._folder / "trace" / f"{pid}.json"

    def _traces(self) -> list[Path]:
        return sorted((self._folder / "trace").glob("*.json"))

    def _clear(self) -> None:
        for path in self._traces():
            path.unlink()


def find_passed(
    busy: list[Calls], idle: list[Calls], short_lived: list[Calls], times: int
) -> list[str]:
    """Name the modules whose functions *times* operations called: in *busy* and not in *idle*."""
    passed = {path for calls in short_lived for path, _ in calls}
    for with_it, without in zip(busy, idle, strict=True):
        for function, count in with_it.items():
            if count >= _NEARLY_ALWAYS * times and without[function] <= _HARDLY_EVER * times:
                passed.add(function[0])
    names = (path.removesuffix(".py").replace("/", ".") for path in passed)
    return sorted(name for name in names if name.partition(".")[0] in PACKAGES)


class PlantError(Exception):
    """The demo plant does not run."""


@contextmanager
def _run(root: Path, folder: str) -> Iterator[_Plant]:
    """Run the demo plant until the block ends, with the bus in OP at its begin.

    Raises:
        PlantError: A demo plant runs already, or this one ended; with what it wrote.
    """
    if _is_taken():
        raise PlantError(f"{_ADDRESS}:48898 is in use: stop the demo plant that runs already")
    Path(folder, "trace").mkdir()
    plant = _Plant(root, Path(folder))
    command = [sys.executable, "-m", "eap", "run", str(root / "config" / "demo.yaml")]
    log = Path(folder, "log")
    with log.open("w") as output:
        process = subprocess.Popen(
            command, cwd=root, env=plant.environment, stdout=output, stderr=output
        )
    try:
        _wait(lambda: process.poll() is not None or _answers())
        if process.poll() is not None:
            raise PlantError(f"the demo plant ended with {process.returncode}:\n{log.read_text()}")
        plant.find_processes(process.pid)
        yield plant
    except TimeoutError as exc:
        exc.add_note(log.read_text())
        raise
    finally:
        process.terminate()
        process.wait()


def _is_taken() -> bool:
    try:
        socket.create_connection((_ADDRESS, 48898), timeout=5).close()
    except OSError:
        return False
    return True


def _answers() -> bool:
    try:
        with socket.create_connection((_ADDRESS, 48898), timeout=5) as connection:
            _read_sdo(connection)
    except (OSError, ValueError):
        return False
    return True


def _read_sdo(connection: socket.socket) -> None:
    """Read 0x1018:01 of the first slave, by ADS.

    Raises:
        ValueError: The slave does not answer yet.
    """
    group = struct.pack("<III", 0xF302, 0x1018 << 16 | 1, 4)
    client = bytes((127, 0, 0, 1, 1, 1))
    header = struct.pack("<6sH6sHHHIII", _BUS, 1001, client, 40000, 2, 4, len(group), 0, 1)
    packet = header + group
    connection.sendall(struct.pack("<HI", 0, len(packet)) + packet)
    answer = connection.recv(6 + 32 + 8 + 4, socket.MSG_WAITALL)
    if len(answer) < 50 or answer[38:42] != bytes(4):
        raise ValueError(answer)


def _command_line(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def read_calls(path: Path) -> Calls:
    """Return what the tracer of one process wrote."""
    return Counter({(file, name): count for file, name, count in json.loads(path.read_bytes())})


def _wait(is_true: Callable[[], bool]) -> None:
    end = time.monotonic() + _TIMEOUT_S
    while not is_true():
        if time.monotonic() > end:
            raise TimeoutError("the demo plant does not answer: is another one running?")
        time.sleep(0.1)  # noqa: TID251  until a condition holds
