"""docs/routes.md tells the truth: its commands run and print what it says, its screens look so."""

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

from eap.appliance.commands.route_lists import list_routes
from eap.cli.routes_tui.app import RoutesApp
from eap.cli.routes_tui.link import Link
from tests.support.appliance import wait_until
from tests.support.screens import Screen, play

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "routes.md").read_text()
BLOCK = re.compile(r"```(xml|console|text)\n(.*?)```", re.DOTALL)
KEYS = [("down", "t", "escape"), ("down", "down", "t")]
"""What is pressed before each screen of the page."""


def outline(text: str) -> str:
    """Reduce an output to what is the same in every run."""
    text = re.sub(r"\d+(\.\d+)? (µs|ms|s|min)\b", "TIME", text)
    text = re.sub(r"\d\d:\d\d:\d\d", "CLOCK", text)
    text = re.sub(r":3\d{4}(?=: TIME)", ":PORT", text)
    text = re.sub(r"(?<![\w.:-])\d+(\.\d+)?k?(?![\w.:-])", "N", text)
    text = re.sub(r"─+", "─", text)
    return "\n".join(" ".join(line.split()) for line in text.splitlines())


class Shell:
    """A folder, and commands in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "config").symlink_to(ROOT / "config")
        program = folder / "eapctl"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m eap "$@"\n')
        program.chmod(0o755)
        os.environ["EAP_RUNTIME_DIR"] = str(folder / "run")
        self._environment = os.environ | {
            "PATH": f"{folder}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "COLUMNS": "100",
        }
        self._running: list[subprocess.Popen[str]] = []

    def run(self, command: str) -> str:
        """Return what a command prints on both ways out; one behind & prints a line, and stays."""
        if command.endswith(" &"):
            process = subprocess.Popen(
                command.removesuffix(" &").split(), cwd=self.folder, env=self._environment,
                stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            self._running.append(process)
            assert process.stdout is not None
            return process.stdout.readline()
        done = subprocess.run(
            ["sh", "-c", command], cwd=self.folder, env=self._environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        return done.stdout

    def close(self) -> None:
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.communicate(timeout=20)


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> Iterator[Shell]:
    folder = Path(tempfile.mkdtemp(prefix="eap-"))  # short enough for a socket's path
    monkeypatch.setenv("EAP_RUNTIME_DIR", "")  # so that it is as before in the end
    shell = Shell(folder)
    try:
        yield shell
    finally:
        shell.close()
        shutil.rmtree(folder)


def screen_after(keys: tuple[str, ...]) -> str:
    """Return what the live view shows on 80 columns and 24 lines after some keys."""
    shown = []

    async def script(screen: Screen) -> None:
        shown.append(await screen.press(*keys))

    play(RoutesApp(Link(None), period_s=1000.0), script)
    return "\n".join(line.rstrip() for line in shown[0].splitlines()) + "\n"


def routes_are_known() -> bool:
    rows = [row for each in list_routes(None, None) for row in each.stations]
    return all(route.state != "unknown" for row in rows for route in row.routes) and all(
        len(row.connections) == len(rows) - 1 for row in rows
    )


def replay(shell: Shell) -> Iterator[tuple[str, str, str]]:
    """Yield what is done, what the page says comes of it, and what does."""
    keys = iter(KEYS)
    for kind, text in BLOCK.findall(PAGE):
        if kind == "xml":
            (shell.folder / "StaticRoutes.xml").write_text(text)
        elif kind == "text":
            pressed = next(keys)
            yield f"keys {pressed}", text, screen_after(pressed)
        else:
            for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
                command, _, expected = part.partition("\n")
                yield command, expected, shell.run(command)
                if command.endswith(" &"):
                    wait_until(routes_are_known, 10)


def test_the_whole_page(shell: Shell) -> None:
    for command, expected, found in replay(shell):
        assert outline(found) == outline(expected), f"{command}\n{found}"
