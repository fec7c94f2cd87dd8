"""The script that installs npm packages, with an npm of its own."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "tools").mkdir()
    shutil.copy(ROOT / "tools/npm_peers.sh", tmp_path / "tools")
    (tmp_path / "tests/peers").mkdir(parents=True)
    (tmp_path / "tests/peers/package.json").write_text("{}")
    return tmp_path


def install(tree: Path, npm: str) -> subprocess.CompletedProcess[str]:
    program = tree / "bin/npm"
    program.parent.mkdir(exist_ok=True)
    program.write_text(f"#!/bin/sh\n{npm}\n")
    program.chmod(0o755)
    return subprocess.run(
        ["sh", tree / "tools/npm_peers.sh"], capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": f"{program.parent}:{os.environ['PATH']}"},
    )  # fmt: skip


def test_npm_peers_are_installed_once_and_after_a_change_of_the_list(tree: Path) -> None:
    npm = "mkdir -p node_modules; echo installed >> ../../count"
    for times, changed in (1, False), (1, False), (2, True):
        if changed:
            stamp = (tree / "tests/peers/node_modules/.stamp").stat().st_mtime
            os.utime(tree / "tests/peers/package.json", (stamp + 1, stamp + 1))
        assert install(tree, npm).returncode == 0
        assert (tree / "count").read_text().count("installed") == times


def test_npm_peers_that_are_installed_in_part_are_removed(tree: Path) -> None:
    done = install(tree, "mkdir -p node_modules/half; echo no registry >&2; exit 1")
    assert done.returncode == 1
    reason = "npm could not install them; its own message is above"
    assert done.stderr == f"no registry\nmake test: tests with npm packages are skipped: {reason}\n"
    assert not (tree / "tests/peers/node_modules").exists()
