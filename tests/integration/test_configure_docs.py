"""docs/configure.md tells the truth: its commands run and print what it says."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.net

PAGE = (Path(__file__).parents[2] / "docs" / "configure.md").read_text()
BLOCK = re.compile(r"```(yaml|console)\n(.*?)```", re.DOTALL)
READY_S = 15.0


class Shell:
    """A folder, and commands in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        bin_folder = folder / "bin"
        bin_folder.mkdir()
        program = bin_folder / "eapctl"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m eap "$@"\n')
        program.chmod(0o755)
        self._environment = os.environ | {
            "PATH": f"{bin_folder}:{os.environ['PATH']}",
            "PYTHONPATH": str(Path(__file__).parents[2]),
            "EAP_RUNTIME_DIR": str(folder / "run"),
            "EAP_STATE_DIR": str(folder / "state"),
        }
        self._running: list[subprocess.Popen[str]] = []

    def run(self, command: str) -> str:
        """Return what a command prints on both ways out; one behind & prints a line, and stays."""
        if command.endswith(" &"):
            words = command.removesuffix(" &").split()
            process = subprocess.Popen(
                words, cwd=self.folder, env=self._environment, stdout=subprocess.PIPE, text=True
            )
            self._running.append(process)
            assert process.stdout is not None
            return process.stdout.readline()
        done = subprocess.run(
            ["sh", "-c", command],
            cwd=self.folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        return done.stdout

    def close(self) -> None:
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.communicate(timeout=10)


@pytest.fixture
def shell() -> Iterator[Shell]:
    folder = Path(tempfile.mkdtemp(prefix="eap-"))  # short enough for a socket's path
    shell = Shell(folder)
    try:
        yield shell
    finally:
        shell.close()
        shutil.rmtree(folder)


def test_the_whole_page(shell: Shell) -> None:
    for kind, text in BLOCK.findall(PAGE):
        if kind == "yaml":
            name = text.partition("\n")[0].removeprefix("# ")
            (shell.folder / name).write_text(text)
            continue
        for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
            command, _, expected = part.partition("\n")
            assert shell.run(command) == expected, command
