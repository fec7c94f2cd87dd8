"""Start-up of a child process: its entry point, and the steps that it reports to the supervisor.

The supervisor runs ``python -m eap.runtime.startup MODULE HANDOVER_FD REPORT_FD BYTECODE``.  This
module imports next to nothing, so that the first report comes before the imports of the process.

Where Python may write no bytecode (PYTHONDONTWRITEBYTECODE, or a folder of another user), half of a
start is compilation.  BYTECODE is a folder where it is kept for the next start, else empty.
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from time import monotonic
from types import CodeType, FrameType, ModuleType
from typing import Any, TypeAlias

import msgspec

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def catch_end_signals() -> Iterator[int]:
    """Give a descriptor that becomes readable on SIGINT or SIGTERM.

    The handlers from before are back when the block ends.
    """
    read_end, write_end = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    # A handler in Python alone would not end a poll that waits: PEP 475 repeats it.
    old_fd = signal.set_wakeup_fd(write_end)
    old = [signal.signal(number, lambda *_: None) for number in _NUMBERS]
    try:
        yield read_end
    finally:
        for number, handler in zip(_NUMBERS, old, strict=True):
            signal.signal(number, handler)
        signal.set_wakeup_fd(old_fd)
        os.close(read_end)
        os.close(write_end)


Step: TypeAlias = Callable[[str], None]
"""Reports the beginning of a step."""

LIFE_PERIOD_S = 1.0
"""Interval in which a process that runs gives signs of life."""
_IMPORT_PERIOD_S = 0.5
"""Interval of progress reports while a process imports."""


class Report(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of a process to its supervisor: a step that begins, or that it runs."""

    step: str = ""
    waits_for: str = ""
    """Process without which this step cannot end."""
    ready: dict[str, Any] | None = None
    """Report of the process for ``status``, when it runs."""
    is_watched: bool = False
    """True if it gives signs of life from then on."""


class Startup:
    """Start-up of this process, as the supervisor follows it.

    Args:
        fd: Where reports go, one JSON object a line; closed when the process runs, unless it gives
            signs of life.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._last = Report()

    def step(self, text: str, *, waits_for: str = "") -> None:
        """Report the beginning of a step; *waits_for* names the process that has to come first."""
        report = Report(step=text, waits_for=waits_for)
        if report == self._last:
            return
        self._last = report
        with suppress(OSError):  # a supervisor that does not read, or has gone, stops no start
            self._write(report)

    def finish(self, report: dict[str, Any], *, is_watched: bool = False) -> None:
        """Report that this process runs, with a *report* for ``status``.

        Args:
            report: Of this process.
            is_watched: Whether it calls :meth:`beat` from now on: the supervisor kills it when it
                stops to do so.
        """
        self._write(Report(ready=report, is_watched=is_watched))
        if not is_watched:
            os.close(self._fd)

    def beat(self) -> None:
        """Give a sign of life, from the loop that does the work; every ``LIFE_PERIOD_S``."""
        with suppress(OSError):  # the supervisor has gone, or has not read for long
            os.write(self._fd, b"\n")

    def _write(self, report: Report) -> None:
        os.write(self._fd, msgspec.json.encode(report) + b"\n")


def no_step(text: str) -> None:
    """Report nothing: for objects of a process that are built outside one."""


class _Finder:
    """Module finder that reports the progress of imports, and keeps bytecode that Python would not.

    Args:
        startup: Takes the reports.
        folder: Where bytecode is kept; empty if Python keeps it beside the modules.
    """

    def __init__(self, startup: Startup, folder: str) -> None:
        self._startup = startup
        self._folder = folder
        self._count = 0
        self._report_at_s = monotonic() + _IMPORT_PERIOD_S

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to import a module, None where that is nothing special."""
        self._count += 1
        if monotonic() >= self._report_at_s:
            self._report_at_s = monotonic() + _IMPORT_PERIOD_S
            self._startup.step(f"importing modules, {self._count} so far")
        if not self._folder:
            return None
        spec = PathFinder.find_spec(name, path, target)
        # Bytecode beside the module is used as it is, even if no new one may be written.
        if spec is None or spec.cached is None or os.path.exists(spec.cached):  # noqa: PTH110
            return spec
        if type(spec.loader) is SourceFileLoader:
            spec.loader = _Loader(name, spec.loader.path, self._folder)
        return spec


class _Loader(SourceFileLoader):
    """Loader of a module whose bytecode is kept in *folder*."""

    def __init__(self, name: str, path: str, folder: str) -> None:
        super().__init__(name, path)
        self._folder = folder

    def get_code(self, fullname: str) -> CodeType | None:
        """Return the code, from bytecode or to be kept as such."""
        before = sys.dont_write_bytecode, sys.pycache_prefix
        sys.dont_write_bytecode, sys.pycache_prefix = False, self._folder
        try:
            return super().get_code(fullname)
        finally:
            sys.dont_write_bytecode, sys.pycache_prefix = before


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Handle SIGINT like SIGTERM."""
    signal.raise_signal(signal.SIGTERM)


def main(arguments: list[str]) -> int:
    """Run ``main`` of a module, with its handover and its start-up; return its exit code."""
    module, handover, report, folder = arguments
    signal.signal(signal.SIGINT, _interrupted)
    # The supervisor blocked it before the fork, until there is a handler.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    startup = Startup(int(report))
    startup.step("importing modules")
    finder = _Finder(startup, folder)
    sys.meta_path.insert(0, finder)
    gc.disable()  # what modules make stays, and looking through it takes a tenth of the time
    try:
        run = importlib.import_module(module).main
    finally:
        sys.meta_path.remove(finder)
        gc.freeze()
        gc.enable()
    code: int = run(int(handover), startup)
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
