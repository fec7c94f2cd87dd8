"""Two network namespaces with a cable between them, and processes at its ends."""

from __future__ import annotations

import mmap
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec

from tools.bench import machine

ROOT = Path(__file__).resolve().parents[2]
_ANSWER_WITHIN_S = 90.0


class Page:
    """A few words that the processes of one measurement share.

    Attributes:
        words: RECEIVED, the reference receiver's count; STOP, set when receivers shall end; JOINED,
            set when a receiver hears the sender; PHASE, number of the part that a process may
            begin.
    """

    RECEIVED = 0
    STOP = 1
    JOINED = 2
    PHASE = 3

    def __init__(self, path: Path) -> None:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        os.ftruncate(fd, mmap.PAGESIZE)
        self.words = memoryview(mmap.mmap(fd, mmap.PAGESIZE)).cast("q")
        os.close(fd)


class Worker:
    """A process that prints a line of JSON when it is ready and one when it is done."""

    def __init__(self, command: Sequence[str]) -> None:
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT)

    def answer(self, longer_s: float = 0.0) -> dict[str, Any]:
        """Wait for the next line; raise RuntimeError if the process ends or hangs instead."""
        output = self._process.stdout
        assert output is not None  # noqa: S101  it was asked for
        ready, _, _ = select.select([output], [], [], _ANSWER_WITHIN_S + longer_s)
        line = output.readline() if ready else b""
        if not line:
            raise RuntimeError(f"{self._process.args!r} ended or hangs without an answer")
        return msgspec.json.decode(line, type=dict[str, Any])

    def close(self) -> None:
        """End the process if it still runs."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()


class Cable:
    """Two namespaces joined by a veth pair, both with a loopback; made for one measurement."""

    def __init__(self, folder: Path, names: tuple[str, str]) -> None:
        self.folder = folder
        self._names = names

    def interface(self, side: int) -> str:
        """Return the name of the interface at that end."""
        return f"{self._names[side]}v"

    def address(self, side: int) -> str:
        """Return the IPv4 address at that end."""
        return f"10.134.164.{side + 1}"

    def command(self, side: int, *words: str) -> list[str]:
        """Return the command line that runs *words* at that end."""
        return ["ip", "netns", "exec", self._names[side], *words]

    @contextmanager
    def worker(self, role: str, job: dict[str, Any], *, side: int, cpu: int) -> Iterator[Worker]:
        """Run a role of ``worker.py`` at one end, pinned to one core."""
        text = msgspec.json.encode(job | {"cpu": cpu}).decode()
        worker = Worker(self.command(side, sys.executable, "-m", "tools.bench.worker", role, text))
        try:
            yield worker
        finally:
            worker.close()


@contextmanager
def cable() -> Iterator[Cable]:
    """Make two namespaces and what joins them; delete them afterwards.

    Raises:
        SkippedError: we are not root, or there is no ``ip``.
    """
    machine.require_root()
    names = (f"eb{os.getpid()}a", f"eb{os.getpid()}b")
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(dir=machine.memory_folder()))
        made = Cable(Path(folder), names)
        for name in names:
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "del", name)
        ends = [made.interface(side) for side in (0, 1)]
        _ip("link", "add", ends[0], "netns", names[0], "type", "veth",
            "peer", "name", ends[1], "netns", names[1])  # fmt: skip
        for side, name in enumerate(names):
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", name, "link", "set", ends[side], "addrgenmode", "none")
            _ip("-n", name, "addr", "add", f"{made.address(side)}/24", "dev", ends[side])
            _ip("-n", name, "link", "set", ends[side], "up")
        yield made


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)
