"""``make valve``: the switch of one bus opens the valve of another one, and nothing else does."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
TIMEOUT_MS = 50


def test_switch_opens_the_valve_and_a_killed_engine_closes_it() -> None:
    done = subprocess.run(
        [sys.executable, "tools/valve_demo.py", "--moves", "2"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line.strip() for line in done.stdout.splitlines()]
    says = [line.rpartition(" ")[2] for line in lines if line.startswith("its slave says")]
    assert says == ["1", "0", "1", "0", "1", "1", "0"]  # two moves, the kill, the power
    closed = next(line for line in lines if "closed by the substitute" in line)
    assert float(re.findall(r"([\d.]+) ms", closed)[0]) > TIMEOUT_MS / 2
