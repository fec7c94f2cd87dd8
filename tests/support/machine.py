"""How busy this machine is: limits on what starts a process are stretched by that, not by more."""

from __future__ import annotations

import subprocess
import sys
import time

USUAL_START_S = 0.3
"""What the start of an engine's interpreter takes on a machine that has nothing else to do."""


def slowness() -> float:
    """Return how many times longer than usual the start of a process takes now, at least 1."""
    start = time.monotonic()
    command = [sys.executable, "-c", "import eap.engine.process"]
    subprocess.run(command, check=True)
    return max(1.0, (time.monotonic() - start) / USUAL_START_S)
