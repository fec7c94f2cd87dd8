"""A terminal of tmux in which a test runs a program, presses keys, and reads the screen."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

HAS_TMUX = shutil.which("tmux") is not None


class Terminal:
    """One window of a tmux server of its own."""

    def __init__(self, socket: Path) -> None:
        self._tmux = ["tmux", "-S", str(socket), "-f", "/dev/null"]

    def press(self, *keys: str) -> None:
        """Press keys, by their names in tmux."""
        self._run("send-keys", *keys)

    def text(self) -> str:
        """Return what is on the screen, empty when the program has ended."""
        done = subprocess.run(
            [*self._tmux, "capture-pane", "-p"], capture_output=True, text=True, check=False
        )
        return done.stdout

    def wait_for(self, *words: str, timeout_s: float = 40.0) -> str:
        """Return the screen as soon as all *words* are on it."""
        return self.wait_until(lambda text: all(word in text for word in words), timeout_s)

    def wait_until(self, holds: Callable[[str], bool], timeout_s: float = 40.0) -> str:
        """Return the screen as soon as *holds* of it is true."""
        end_s = time.monotonic() + timeout_s
        while not holds(text := self.text()):
            assert time.monotonic() < end_s, f"not on the screen:\n{text}"
            time.sleep(0.02)
        return text

    def _run(self, *words: str) -> None:
        subprocess.run([*self._tmux, *words], check=True, capture_output=True)


@contextmanager
def terminal(
    folder: Path, command: Sequence[str], size: tuple[int, int], **environment: str
) -> Iterator[Terminal]:
    """Run a command on a terminal of *size*, columns and lines, and end it afterwards.

    Args:
        folder: Where the socket of tmux goes.
        command: Words of the command.
        size: Columns and lines.
        **environment: Variables of the command beside those of the test.
    """
    socket = folder / "tmux"
    columns, lines = map(str, size)
    shell = shlex.join(
        ["env", *(f"{name}={value}" for name, value in environment.items()), *command]
    )
    words = ["-S", str(socket), "-f", "/dev/null", "new-session", "-d", "-x", columns, "-y", lines]
    subprocess.run(["tmux", *words, shell], check=True, env=os.environ | environment)
    found = Terminal(socket)
    try:
        yield found
    finally:
        subprocess.run(["tmux", "-S", str(socket), "kill-server"], check=False, capture_output=True)
        # A server that is still ending would refuse the next session.
        socket.unlink(missing_ok=True)
