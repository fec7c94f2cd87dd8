"""Recordings of this user: a folder of each in the runtime directory, by which it is found.

A recorder holds the lock of its folder; the kernel drops that however the recorder ends.  What it
wrote there last remains, so that a recording that was killed is listed as such.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import msgspec

from eap.closeable import Closeable
from eap.errors import EnvironmentalError
from eap.quantities import count
from eap.runtime.folder import (
    MAX_SOCKET_PATH,
    ApplianceFolder,
    folder_name,
    runtime_root,
    runtime_roots,
    take_lock,
)

_FOLDER = ".recordings"
_THINGS = {"values": "variable", "frames": "port"}
KEPT = 32
"""Recordings that ended and are listed; older ones are forgotten, their files are not."""


class RecordingState(msgspec.Struct, kw_only=True):
    """One recording, as its recorder described it last.

    Attributes:
        name: Its name.
        kind: ``values`` or ``frames``.
        plant: The plant.
        pid: Process id of the recorder.
        state: ``starting``, ``recording``, ``armed`` (a ring that waits for its condition),
            ``waiting`` (the plant does not run), ``ended`` or ``killed``.
        reason: Reason of the end, or of the waiting.
        failed: Whether it ended by a fault.
        started_at: Unix time of the start.
        ended_at: Unix time of the end.
        selected: Number of variables or ports.
        messages: Messages or frames written.
        octets: Bytes written.
        lost: Cycles or frames that the recorder missed.
        not_stored: Cycles that the store of ``--to`` did not take in time.
        triggers: Times at which the condition became true.
        ring_s: Seconds in memory.
        ring_is_cut: Whether the ring is shorter than wanted, for want of memory.
        files: Those that there are, the newest last.
        options: Of the command.
        is_of_plant: Whether the plant file has it; it ends with the plant.
    """

    name: str
    kind: str
    plant: str
    pid: int = 0
    state: str = "starting"
    reason: str = ""
    failed: bool = False
    started_at: float = 0.0
    ended_at: float | None = None
    selected: int = 0
    messages: int = 0
    octets: int = 0
    lost: int = 0
    not_stored: int = 0
    triggers: int = 0
    ring_s: float | None = None
    ring_is_cut: bool = False
    files: list[str] = []
    options: dict[str, str] = {}
    is_of_plant: bool = False

    @property
    def is_over(self) -> bool:
        """True if it ended or was killed."""
        return self.state in {"ended", "killed"}


class RecordingFolder(Closeable):
    """The folder of one recording; its recorder holds the lock until ``close``."""

    def __init__(self, path: Path, lock_fd: int = -1) -> None:
        self.path = path
        self._lock_fd = lock_fd

    @classmethod
    def claim(cls, name: str) -> Self:
        """Make the folder of the recording *name* and lock it; one that ended is replaced.

        Raises:
            EnvironmentalError: a recording of that name runs, or the folder cannot be made.
        """
        path = runtime_root() / _FOLDER / folder_name(name)
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock_fd = os.open(path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as exc:
            raise EnvironmentalError(f"{path}: {exc.strerror}") from None
        try:
            take_lock(lock_fd)
        except BlockingIOError:
            os.close(lock_fd)
            raise EnvironmentalError(
                f"recording {name!r} runs already: choose another name with -o, or end it with"
                f" 'eapctl record stop {name}'"
            ) from None
        folder = cls(path, lock_fd)
        if len(os.fsencode(folder.control_socket)) > MAX_SOCKET_PATH:
            folder.close()
            raise EnvironmentalError(
                f"{folder.control_socket} is too long for a socket's path (at most"
                f" {MAX_SOCKET_PATH} bytes): choose a shorter name"
            )
        for entry in path.iterdir():
            if entry.name != "lock":
                entry.unlink()
        return folder

    @property
    def control_socket(self) -> Path:
        """Socket that takes requests."""
        return self.path / "control"

    @property
    def log(self) -> Path:
        """Output of the recorder."""
        return self.path / "log"

    def write(self, state: RecordingState) -> None:
        """Replace the description in one step."""
        temporary = self.path / "state.json.new"
        temporary.write_bytes(msgspec.json.encode(state))
        temporary.replace(self.path / "state.json")

    def read(self) -> RecordingState:
        """Return the description; ``killed`` if its recorder has gone without a word.

        Raises:
            OSError, ValueError: there is none.
        """
        is_alive = self.is_alive()
        state = msgspec.json.decode((self.path / "state.json").read_bytes(), type=RecordingState)
        if not is_alive and not state.is_over:
            state.state, state.reason = "killed", f"the recorder was killed{self._last_line()}"
            state.failed = True
            state.ended_at = (self.path / "state.json").stat().st_mtime
        return state

    def _last_line(self) -> str:
        """Return what its recorder wrote last about an error."""
        with suppress(OSError):
            lines = self.log.read_text(errors="replace").split("\n")
            if last := next((each for each in reversed(lines) if each.strip()), ""):
                return f": {last[:200]}"
        return ""

    def is_alive(self) -> bool:
        """Return whether a recorder holds the lock."""
        return ApplianceFolder(self.path).is_alive()

    def close(self) -> None:
        """Let go of the lock; the description stays."""
        if self._lock_fd >= 0:
            self.control_socket.unlink(missing_ok=True)
            os.close(self._lock_fd)
            self._lock_fd = -1


def find_recordings() -> list[tuple[RecordingFolder, RecordingState]]:
    """Return all recordings, those that began first coming first."""
    found = []
    for root in runtime_roots():
        with suppress(OSError):
            for path in (root / _FOLDER).iterdir():
                folder = RecordingFolder(path)
                with suppress(OSError, ValueError):
                    found.append((folder, folder.read()))
    return sorted(found, key=lambda each: each[1].started_at)


SHOWN_S = 3600.0
"""Time for which a recording that failed is a finding of ``status``."""


def recording_findings(plant: str, now_s: float) -> list[dict[str, Any]]:
    """Return the recordings of *plant* as findings of ``status``; *now_s* is Unix time."""
    states = [state for _, state in find_recordings() if state.plant == plant]
    return [finding for state in states if (finding := _finding(state, now_s))]


def _finding(state: RecordingState, now_s: float) -> dict[str, Any] | None:
    severity, advice, since = "info", "", None
    what = f"{state.state}, {count(state.selected, _THINGS[state.kind])}"
    if state.is_over:
        # The supervisor reports the process of a recording of the plant, and starts it again.
        if state.is_of_plant or not state.failed or now_s - (state.ended_at or 0) > SHOWN_S:
            return None
        severity, since = "warning", state.ended_at
        what = f"{state.state}: {state.reason}"
        advice = "'eapctl record list' shows its files; start another one"
    elif state.lost:
        severity, what = "warning", f"{what}, {state.lost} lost"
        advice = "the machine is too busy for it: record less, or each N-th cycle by --every"
    elif state.not_stored:
        severity = "warning"
        what = ": ".join(filter(None, (f"{what}, {state.not_stored} not stored", state.reason)))
        advice = "the store was away for too long, or is too slow: see its log, or record less"
    elif state.reason:
        what = f"{what}: {state.reason}"
        if state.state == "recording":
            severity, advice = "warning", "rows wait in memory until the store answers"
    return {
        "severity": severity,
        "where": f"recording {state.name}",
        "what": what,
        "advice": advice,
        "since": since,
    }


def forget_old_recordings() -> None:
    """Remove the folders of recordings that ended long ago."""
    over = [folder for folder, state in find_recordings() if state.is_over]
    for folder in over[:-KEPT]:
        shutil.rmtree(folder.path, ignore_errors=True)
