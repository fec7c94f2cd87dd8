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
from contextlib import ExitStack
from typing import Any

import msgspec

from eap.runtime.handover import Handover, SegmentHandover
from eap.runtime.startup import Report
from eap.supervisor.output import STDERR
from eap.supervisor.progress import StartWatch

FIRST_BACKOFF_NS = 100_000_000
LONGEST_BACKOFF_NS = 5_000_000_000
HEALTHY_AFTER_NS = 1_000_000_000
"""A process that lived this long is started again at once."""

_LAST_LINES = 12
_LAUNCHER = "eap.runtime.startup"


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
    """A process made from a module; it exists from ``start`` to ``reap``, any number of times.

    Args:
        name: Of the process, in messages.
        module: Has its ``main``.
        bytecode: Folder for bytecode that is kept nowhere else; empty for none.
    """

    def __init__(self, name: str, module: str, bytecode: str = "") -> None:
        self.name = name
        self._bytecode = bytecode
        self.restarts = 0
        self.is_ready = False
        self.report: dict[str, Any] = {}
        self.started_ns = 0
        self.pid_fd = -1
        self.report_fd = -1
        self.error_fd = -1
        self.policy = RestartPolicy()
        self.watch = StartWatch()
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._partial = b""
        self._partial_report = b""

    @property
    def pid(self) -> int:
        """Process id, 0 when there is no process."""
        return self._process.pid if self._process else 0

    def start(
        self, handover: Handover | SegmentHandover, descriptors: Iterable[int], now_ns: int
    ) -> None:
        """Start the process; *descriptors* are those that *handover* speaks of."""
        with ExitStack() as theirs:
            self.report_fd, report_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
            theirs.callback(os.close, report_end)
            self.error_fd, error_end = os.pipe2(os.O_CLOEXEC)
            theirs.callback(os.close, error_end)
            os.set_blocking(self.error_fd, False)
            described = handover.to_descriptor()
            theirs.callback(os.close, described)
            command = [sys.executable, "-m", _LAUNCHER, self._module]
            # A SIGINT before the child can take one would end it with a traceback: it waits.
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            theirs.callback(signal.pthread_sigmask, signal.SIG_SETMASK, mask)
            process = subprocess.Popen(  # noqa: S603  our own module
                [*command, str(described), str(report_end), self._bytecode],
                stdin=subprocess.DEVNULL,
                stdout=error_end,
                stderr=error_end,
                pass_fds=(described, report_end, *descriptors),
                process_group=0,  # a terminal's Ctrl-C reaches the supervisor alone
            )
        try:
            self.pid_fd = os.pidfd_open(process.pid)
        except OSError:  # its end would not be noticed
            process.kill()
            process.wait()
            raise
        self._process = process
        self.started_ns = now_ns
        self.watch.begin(now_ns)
        self.is_ready = False
        self._last_lines.clear()
        self._partial_report = b""

    def take_reports(self) -> list[Report]:
        """Return what the process reported since the last time.

        *report_fd* is closed when the process runs, and also if it died before.
        """
        data = os.read(self.report_fd, 65536)
        *lines, self._partial_report = (self._partial_report + data).split(b"\n")
        reports = [msgspec.json.decode(line, type=Report) for line in lines]
        for each in reports:
            if each.ready is not None:
                self.is_ready = True
                self.report = each.ready
        if self.is_ready or not data:
            os.close(self.report_fd)
            self.report_fd = -1
        return reports

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
        self.is_ready = False
        self.watch.end()
        self._process = None
        return code, self._last_lines[-1] if self._last_lines else "it said nothing"

    def close(self) -> None:
        """Close what is left of the descriptors."""
        for fd in (self.pid_fd, self.report_fd, self.error_fd):
            if fd >= 0:
                os.close(fd)
        self.pid_fd = self.report_fd = self.error_fd = -1


def describe_end(code: int) -> str:
    """Return how a process ended, in words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
