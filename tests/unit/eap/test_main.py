from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.net  # starts a process


def test_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "eap", "chek"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    hint = "did you mean check? (see 'eapctl --help')"
    assert done.stderr == f"eapctl: unknown command 'chek', {hint}\n"


def test_eapctl_interrupted_while_it_imports_ends_without_a_traceback(tmp_path: Path) -> None:
    (tmp_path / "click.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{Path.cwd()}"}
    done = subprocess.run(
        [sys.executable, "-m", "eap", "--help"],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")
