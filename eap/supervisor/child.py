"""Child processes of the supervisor: start, progress of the start, output, end and restart.

Nothing in this module waits: the supervisor watches the descriptors given out here, and log lines
are dropped and counted while their reader is slow.  A terminal can be held (Ctrl-S), and the
reader of a pipe may sleep.  A supervisor that waited for it could not restart a process, and
services, whose lines pass through the supervisor, would stop with it.

A process that reports one step after the other may start without limit of time.  One that reports
no new step is stuck after a limit, which doubles with each start that got stuck: where 20 s are too
short, because the machine is slow or full, 40 s or 80 s are not.  A start that succeeds restores
the first limit.

A process that runs gives signs of life by the same pipe.  They are counted in checks, not by the
clock: a supervisor that was held itself, or a machine that slept, finds no process silent.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack
from enum import Enum
from typing import Any

import msgspec

from eap.runtime.handover import InheritedRecord
from eap.runtime.startup import Report
from eap.supervisor.log_output import LOG

FIRST_LIMIT_NS = 20_000_000_000
"""Without progress, in the first start and behind one that succeeded."""
LONGEST_LIMIT_NS = 640_000_000_000
FIRST_NOTE_NS = 10_000_000_000
"""From the beginning of a start to the first note that it takes long; the next come ever later."""


class StartEvent(Enum):
    """Outcome of the time that passed."""

    SLOW = "slow"
    """The start takes long, and continues."""
    STUCK = "stuck"
    """There was no progress for the limit."""


class StartWatch:
    """Starts of one child process.

    Attributes:
        step: The last that it reported; empty when it runs, or is not being started.
        limit_ns: How long it may be without progress.
        has_run: Whether any start succeeded.
        is_stuck: Whether the latest start was given up.
    """

    def __init__(self) -> None:
        self.step = ""
        self.limit_ns = FIRST_LIMIT_NS
        self.has_run = False
        self.is_stuck = False
        self._began_ns: int | None = None
        self._progress_ns = 0
        self._note_ns = 0
        self._waits_for = ""

    def begin(self, now_ns: int) -> None:
        """Take note that the process was started."""
        self._began_ns = self._progress_ns = now_ns
        self._note_ns = now_ns + FIRST_NOTE_NS
        self._waits_for = ""
        self.step = "starting Python"
        self.is_stuck = False

    def advance(self, step: str, now_ns: int, *, waits_for: str = "") -> None:
        """Take note of a step; while it waits for another process, there is no limit."""
        if step != self.step:
            self._progress_ns = now_ns
        self.step = step
        self._waits_for = waits_for

    def release(self, other: str, now_ns: int) -> None:
        """Note that the process *other* runs, if this one waited for it."""
        if self._waits_for == other:
            self._waits_for = ""
            self._progress_ns = now_ns

    def succeed(self) -> None:
        """Take note that the process runs."""
        self.end()
        self.has_run = True
        self.limit_ns = FIRST_LIMIT_NS

    def end(self) -> None:
        """Take note that the process ended."""
        self.step = self._waits_for = ""
        self._began_ns = None

    def took_ns(self, now_ns: int) -> int:
        """Return how long the start has taken so far; 0 if there is none."""
        return 0 if self._began_ns is None else now_ns - self._began_ns

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        if self._began_ns is None or self.is_stuck:
            return None
        return self._note_ns if self._waits_for else min(self._note_ns, self._deadline_ns)

    def handle_timeout(self, now_ns: int) -> StartEvent | None:
        """Return the event of the start that is due, None if none is; early calls are harmless."""
        due_ns = self.next_timeout()
        if due_ns is None or now_ns < due_ns:
            return None
        if not self._waits_for and now_ns >= self._deadline_ns:
            self.is_stuck = True
            self.limit_ns = min(2 * self.limit_ns, LONGEST_LIMIT_NS)
            return StartEvent.STUCK
        self._note_ns = now_ns + self.took_ns(now_ns)
        return StartEvent.SLOW

    @property
    def _deadline_ns(self) -> int:
        return self._progress_ns + self.limit_ns


LIFE_CHECK_NS = 5_000_000_000
"""Interval of looks for signs of life."""
SILENT_CHECKS = 4
"""Looks in a row without one, after which a process hangs."""
SILENCE_S = LIFE_CHECK_NS * SILENT_CHECKS // 1_000_000_000


class LifeWatch:
    """Signs of life of one process that runs.

    Attributes:
        has_hung: Whether it was silent for too long.
    """

    def __init__(self) -> None:
        self.has_hung = False
        self._silent = 0

    def check(self, *, is_alive: bool) -> bool:
        """Take note of a look; return True the first time that the process hangs."""
        self._silent = 0 if is_alive else self._silent + 1
        if self.has_hung or self._silent < SILENT_CHECKS:
            return False
        self.has_hung = True
        return True


FIRST_BACKOFF_NS = 100_000_000
LONGEST_BACKOFF_NS = 5_000_000_000
HEALTHY_AFTER_NS = 1_000_000_000
"""A process that lived this long is started again at once."""

_FAILURES = 3
"""Ends of a process without a start that succeeded, after which it does not count as alive."""
_LAST_LINES = 12
_LAUNCHER = "eap.runtime.startup"


class RestartPolicy:
    """Restart delay of a process: none after a long life, growing after short ones."""

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
        self.fault = ""
        """Reason that an optional process does not run, for ``status``."""
        self.is_ready = False
        self._is_watched = False
        self._failures = 0
        """Ends since it was ready last."""
        self.report: dict[str, Any] = {}
        self.started_ns = 0
        self.pid_fd = -1
        self.report_fd = -1
        self.error_fd = -1
        self.policy = RestartPolicy()
        self.watch = StartWatch()
        self.life = LifeWatch()
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._partial = b""
        self._partial_report = b""

    @property
    def pid(self) -> int:
        """Process id, 0 when there is no process."""
        return self._process.pid if self._process else 0

    @property
    def is_alive(self) -> bool:
        """True if it runs, or is being started and not again and again in vain."""
        is_starting = self.pid and not self.watch.is_stuck and self._failures < _FAILURES
        return self.is_ready or bool(is_starting)

    def start(self, handover: InheritedRecord, descriptors: Iterable[int], now_ns: int) -> None:
        """Start the process; *descriptors* are those that *handover* speaks of."""
        with ExitStack() as theirs:
            self.report_fd, report_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
            theirs.callback(os.close, report_end)
            self.error_fd, error_end = os.pipe2(os.O_CLOEXEC)
            theirs.callback(os.close, error_end)
            # This end alone: the child may wait for its output to be read, the supervisor may not.
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
            # A descriptor can be polled with the others, and never means another process of the
            # same id.
            self.pid_fd = os.pidfd_open(process.pid)
        except OSError:  # its end would not be noticed
            process.kill()
            process.wait()
            raise
        self._process = process
        self.started_ns = now_ns
        self.watch.begin(now_ns)
        self.life = LifeWatch()
        self.is_ready = self._is_watched = False
        self._last_lines.clear()
        self._partial_report = b""

    def read_reports(self) -> list[Report]:
        """Return what the process reported since the last time.

        *report_fd* is closed when the process runs, unless it gives signs of life by it, and also
        if it died before.
        """
        # A report may come in two pieces; what follows the last newline waits for the rest.
        data = os.read(self.report_fd, 65536)
        *lines, self._partial_report = (self._partial_report + data).split(b"\n")
        reports = [msgspec.json.decode(line, type=Report) for line in lines if line]
        for each in reports:
            if each.ready is not None:
                self.is_ready = True
                self._is_watched = each.is_watched
                self._failures = 0
                self.report = each.ready
        if (self.is_ready and not self._is_watched) or not data:
            os.close(self.report_fd)
            self.report_fd = -1
        return reports

    def has_beaten(self) -> bool:
        """Return whether there was a sign of life since the last time, or none is due."""
        if not self._is_watched or self.report_fd < 0:
            return True
        try:
            return bool(os.read(self.report_fd, 65536))
        except BlockingIOError:
            return False

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
            text = LOG.pass_on(self.name, line.decode("utf-8", "replace"))
            self._last_lines.append(text)
        return bool(data)

    def send_signal(self, number: signal.Signals) -> None:
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
        self._failures += 1
        self.watch.end()
        self._process = None
        return code, self._last_lines[-1] if self._last_lines else "no output"

    def close(self) -> None:
        """Close the remaining descriptors."""
        for fd in (self.pid_fd, self.report_fd, self.error_fd):
            if fd >= 0:
                os.close(fd)
        self.pid_fd = self.report_fd = self.error_fd = -1


def describe_end(code: int) -> str:
    """Return the end of a process as text."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
