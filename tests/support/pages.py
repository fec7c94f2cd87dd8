"""Examples of a page of the docs, run as a reader would."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from unittest import mock

from click.testing import CliRunner

from eap.cli.group import main as eapctl
from tests.support.appliance import start_eapctl

ROOT = Path(__file__).parents[2]
_EAPCTL = re.compile(r"eapctl( [^|&;<>$*'\"\\]+)+")
"""A command line that needs no shell."""
_RUN = """
import doctest, pathlib, sys
page = pathlib.Path(sys.argv[1])
test = doctest.DocTestParser().get_doctest(page.read_text(), {}, page.name, page.name, 0)
result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test)
print(result.attempted, "examples")
sys.exit(bool(result.failed))
"""


def run_examples(page: Path, at_least: int) -> None:
    """Run the examples of *page* in a Python of their own; there are *at_least* so many.

    Not in the process of the tests: pyads keeps connections there that another test's plant ended.
    """
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(page)],
        check=False,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.splitlines()[-1].split()[0]) >= at_least


class Shell:
    """A folder, and the commands of a page in it.

    Args:
        folder: Its path is short enough for a socket's.
        environment: More variables.
    """

    def __init__(self, folder: Path, **environment: str) -> None:
        self.folder = folder
        bin_folder = folder / "bin"
        bin_folder.mkdir()
        program = bin_folder / "eapctl"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m eap "$@"\n')
        program.chmod(0o755)
        self._environment = {
            "PATH": f"{bin_folder}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "EAP_RUNTIME_DIR": str(folder / "run"),
            "EAP_STATE_DIR": str(folder / "state"),
            **environment,
        }
        self._running: list[subprocess.Popen[str]] = []

    def run(self, command: str) -> str:
        """Return the output of a command, stderr included; of one behind & its first line."""
        if command.endswith(" &"):
            return self._start(command.removesuffix(" &").split())
        with mock.patch.dict(os.environ, self._environment), chdir(self.folder):
            if _EAPCTL.fullmatch(command):
                words = command.split()[1:]
                result = CliRunner().invoke(
                    eapctl, words, prog_name="eapctl", catch_exceptions=False
                )
                return result.output
            done = subprocess.run(
                ["sh", "-c", command],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            return done.stdout

    def end_first(self) -> None:
        """End the command that was started first behind &."""
        process = self._running.pop(0)
        process.terminate()
        process.communicate(timeout=20)

    def close(self) -> None:
        """End what runs."""
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.communicate(timeout=20)

    def _start(self, words: list[str]) -> str:
        options = {"cwd": self.folder, "env": os.environ | self._environment, "text": True}
        if words[0] == "eapctl":
            process = start_eapctl(*words[1:], stdout=subprocess.PIPE, **options)
        else:
            process = subprocess.Popen(words, stdout=subprocess.PIPE, **options)
        self._running.append(process)
        assert process.stdout is not None
        return process.stdout.readline()


@contextmanager
def shell(**environment: str) -> Iterator[Shell]:
    """Make a folder and commands in it; all of it is gone afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="eap-"))
    made = Shell(folder, **environment)
    try:
        yield made
    finally:
        made.close()
        shutil.rmtree(folder)


def commands(block: str) -> Iterator[tuple[str, str]]:
    """Yield each command of a block of the page, and what the page prints below it."""
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, expected = part.partition("\n")
        yield command, expected
