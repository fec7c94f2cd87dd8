from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.net  # starts a process


def test_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "eap", "chek"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == "eapctl: no command 'chek', did you mean check? (see 'eapctl --help')\n"
