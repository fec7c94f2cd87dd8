"""One process under the supervisor: its start, its output, its end, and when it comes back.

The supervisor watches the descriptors that are given out here; nothing in this module waits.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterable
from typing import Any

import msgspec

from eap.appliance.handover import Handover, SegmentHandover, decode_report
from eap.appliance.supervisor.output import STDERR

FIRST_BACKOFF_NS = 100_000_000
LONGEST_BACKOFF_NS = 5_000_000_000
HEALTHY_AFTER_NS = 1_000_000_000
"""A process that lived this long is started again at once."""

_LAST_LINES = 12


class RestartPolicy:
    """When to start a process again: at once after a long life, ever later after short ones."""

    def __init__(self) -> None:
        self._backoff_ns = 0

    def delay_ns(self, lived_ns: int) -> int:
        """Return how long to wait after a life of *lived_ns*."""
        if lived_ns >= HEALTHY_AFTER_NS:
            self._backoff_ns = 0
        delay = self._backoff_ns
        self._backoff_ns = min(max(2 * delay, FIRST_BACKOFF_NS), LONGEST_BACKOFF_NS)
        return delay


class Child:
    """A process made from a module; it exists from ``start`` to ``reap``, any number of times."""

    def __init__(self, name: str, module: str) -> None:
        self.name = name
        self.restarts = 0
        self.is_ready = False
        self.report: dict[str, Any] = {}
        self.started_ns = 0
        self.pid_fd = -1
        self.ready_fd = -1
        self.error_fd = -1
        self.policy = RestartPolicy()
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._partial = b""

    @property
    def pid(self) -> int:
        """Process id, 0 when there is no process."""
        return self._process.pid if self._process else 0

    def start(
        self, handover: Handover | SegmentHandover, descriptors: Iterable[int], now_ns: int
    ) -> None:
        """Start the process; *descriptors* are those that *handover* speaks of."""
        self.ready_fd, ready_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self.error_fd, error_end = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self.error_fd, False)
        described = msgspec.structs.replace(handover, ready_fd=ready_end).to_descriptor()
        try:
            self._process = subprocess.Popen(  # noqa: S603  our own module
                [sys.executable, "-m", self._module, str(described)],
                stdin=subprocess.DEVNULL,
                stdout=error_end,
                stderr=error_end,
                pass_fds=(described, ready_end, *descriptors),
                process_group=0,  # a terminal's Ctrl-C reaches the supervisor alone
            )
        finally:
            for fd in (described, ready_end, error_end):
                os.close(fd)
        self.pid_fd = os.pidfd_open(self._process.pid)
        self.started_ns = now_ns
        self.is_ready = False
        self._last_lines.clear()

    def take_readiness(self) -> bool:
        """Read from *ready_fd*; return whether the process has said that it runs.

        The descriptor is closed then, and also if the process died before.
        """
        line = os.read(self.ready_fd, 65536)
        os.close(self.ready_fd)
        self.ready_fd = -1
        if line:
            self.is_ready = True
            self.report = decode_report(line)
        return self.is_ready

    def forward_output(self) -> bool:
        """Pass on what the process wrote; return whether there was anything.

        The descriptor is closed when nothing more can come.
        """
        try:
            data = os.read(self.error_fd, 65536)
        except BlockingIOError:
            return False
        *lines, self._partial = (self._partial + data).split(b"\n")
        if not data:
            lines = [self._partial] if self._partial else []
            self._partial = b""
            os.close(self.error_fd)
            self.error_fd = -1
        for line in lines:
            self._last_lines.append(line.decode("utf-8", "replace"))
            STDERR.write(self._last_lines[-1])
        return bool(data)

    def ask_to_end(self, number: signal.Signals) -> None:
        """Send a signal, if there is a process."""
        if self._process is not None:
            self._process.send_signal(number)

    def reap(self) -> tuple[int, str]:
        """Take leave of a process that ended; return its code and its last line of output."""
        assert self._process is not None  # noqa: S101  only called for a pid_fd that fired
        code = self._process.wait()
        while self.error_fd >= 0 and self.forward_output():
            pass
        self.close()
        self._process = None
        return code, self._last_lines[-1] if self._last_lines else "it said nothing"

    def close(self) -> None:
        """Close what is left of the descriptors."""
        for fd in (self.pid_fd, self.ready_fd, self.error_fd):
            if fd >= 0:
                os.close(fd)
        self.pid_fd = self.ready_fd = self.error_fd = -1


def describe_end(code: int) -> str:
    """Return how a process ended, in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
