"""Load of this machine: time limits of process starts are stretched by it."""

from __future__ import annotations

import subprocess
import sys
import time

USUAL_START_S = 0.3
"""Time to start an engine's interpreter on an idle machine."""


def slowness() -> float:
    """Return how many times longer than usual the start of a process takes now, at least 1."""
    start = time.monotonic()
    command = [sys.executable, "-c", "import eap.engine.process"]
    subprocess.run(command, check=True)
    return max(1.0, (time.monotonic() - start) / USUAL_START_S)
