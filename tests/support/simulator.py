"""A simulated segment in a process of its own, at the far end of a veth pair."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

from tests.support.appliance import start_eapctl

_CLONE_NEWNET = 0x40000000
NEAR, FAR = "near", "far"
NEAR_2, FAR_2 = "near2", "far2"


def _ip(command: str) -> None:
    subprocess.run(["ip", *command.split()], check=True, capture_output=True)


@contextlib.contextmanager
def veth_pair() -> Iterator[None]:
    """Move this thread, and what it starts, into a network with two cables, NEAR to FAR each."""
    library = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open("rb") as home:
        if library.unshare(_CLONE_NEWNET):
            pytest.skip(f"no network namespace: {os.strerror(ctypes.get_errno())}")
        try:
            _ip("link set lo up")
            # A second network namespace would do no more: the slaves answer at the far ends only.
            for near, far in ((NEAR, FAR), (NEAR_2, FAR_2)):
                _ip(f"link add {near} type veth peer name {far}")
                _ip(f"link set {near} up")
                _ip(f"link set {far} up")
            # The product's socket for queries sees the network that it was made in.
            with (
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as queries,
                mock.patch("eap.net.interface._kernel", return_value=queries),
            ):
                yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)


class Simulator:
    """``eapctl sim run`` while it answers."""

    def __init__(self, bus: Path, interface: str, *more: str) -> None:
        self._process = start_eapctl(
            "sim", "run", str(bus), "--interface", interface, "--faults", *more,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        self.ready = self._read()
        # Foreign masters give a slave milliseconds: where it may, it answers like hardware, however
        # busy the machine is.
        self.pid = self._process.pid
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(self.pid, os.SCHED_FIFO, os.sched_param(1))

    def fault(self, **spec: object) -> dict:
        """Let a fault begin, or with ``end=True`` end; return what the simulator says."""
        self._process.stdin.write(json.dumps(spec) + "\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> int:
        """End it and return its exit code."""
        self._process.terminate()
        with self._process:
            return self._process.wait(10)

    def _read(self) -> dict:
        line = self._process.stdout.readline()
        if not line:
            self.close()
            raise AssertionError("the simulator ended")
        return json.loads(line)


@contextlib.contextmanager
def simulator(bus: Path, interface: str = f"ethernet://{FAR}", *more: str) -> Iterator[Simulator]:
    """Run the bus file *bus*; it ends with exit code 0 behind the block."""
    running = Simulator(bus, interface, *more)
    try:
        yield running
    finally:
        code = running.close()
    assert code == 0
