"""A simulated segment in a process of its own, at the far end of a cable."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tools.bench.network import ROOT, Cable

FAR = 1
_READY_WITHIN_S = 30.0
_END_WITHIN_S = 5.0


class Simulator:
    """``eapctl sim run`` while it answers; *pid* is its process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self.pid = process.pid

    def pin(self, cpu: int, priority: int = 0) -> None:
        """Let it run on one core from now on, with SCHED_FIFO if there is a *priority*."""
        os.sched_setaffinity(self.pid, {cpu})
        if priority:
            os.sched_setscheduler(self.pid, os.SCHED_FIFO, os.sched_param(priority))


@contextmanager
def simulator(link: Cable, bus: Path) -> Iterator[Simulator]:
    """Run the bus file *bus* until the block ends.

    Raises:
        RuntimeError: it does not get ready.
    """
    words = ("sim", "run", str(bus), "--interface", f"ethernet://{link.interface(FAR)}")
    command = link.command(FAR, sys.executable, "-m", "eap", *words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
        try:
            assert process.stdout is not None  # noqa: S101  it was asked for
            fired, _, _ = select.select([process.stdout], [], [], _READY_WITHIN_S)
            if not fired or b'"ready"' not in process.stdout.readline():
                raise RuntimeError(f"eapctl sim run {bus.name} does not get ready")
            yield Simulator(process)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
