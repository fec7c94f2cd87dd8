from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("target", "installed"),
    [
        ("demo", "run"),
        ("valve", "run"),
        ("test", "dev"),
        ("test-tools", "dev"),
        ("properties", "dev"),
        ("check", "dev"),
    ],
)
def test_make_installs_only_what_the_target_needs(target: str, installed: str) -> None:
    done = subprocess.run(
        ["make", "--dry-run", "--always-make", target],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert re.findall(r"tools/venv\.sh (\w+)", done.stdout) == [installed]
