"""The files of one recording: names, division by time or size, number kept, room on the disk.

Everything here is called by one thread, which may wait for the disk; reading the plant goes on
meanwhile in another one.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol, TypeAlias

from eap.errors import EapError, EnvironmentalError
from eap.recording.capture import CapturedBlock, Gap
from eap.recording.header import RecordingEvent

ROOM_BYTES = 2 << 20
"""Left free on the disk in any case: the last chunk and the index of a file need some of it."""
ROOM_SHARE, ROOM_MOST = 20, 100 << 20
"""One part in so many is left free, too, but no more than that."""
_MB = 1 << 20


class DiskFullError(EapError):
    """The disk has no room for more of a recording."""


class RecordingFile(Protocol):
    """One file that is being written."""

    @property
    def size(self) -> int:
        """Bytes of the file so far."""

    @property
    def messages(self) -> int:
        """Number of messages or frames so far."""

    def write(self, block: CapturedBlock) -> None:
        """Add a block."""

    def add_gap(self, gap: Gap) -> None:
        """Add what is missing."""

    def add_event(self, event: RecordingEvent) -> None:
        """Add an event."""

    def flush(self) -> None:
        """Give all to the system, and have the disk keep it."""

    def close(self, time_ns: int) -> None:
        """End the file at Unix time *time_ns*."""

    def abandon(self) -> None:
        """Close the file as it is, for a disk that is full."""


OpenFile: TypeAlias = Callable[[Path, int], RecordingFile]
"""Makes a file that begins at a Unix time."""


class FileSequence:
    """Opens one file after the other, and removes the oldest.

    Args:
        base: Path without number and ending.
        ending: Such as ``.mcap``.
        numbered: Whether the first file has a number, too.
        split_ns: Longest time of a file; 0 for no limit.
        split_bytes: Largest size of a file; 0 for no limit.
        keep: Number of files to keep; 0 for all.
        continues: Whether files with numbers that are there belong to it: it goes on behind them.
        room: Bytes to leave free on the disk; None for the default.

    Attributes:
        paths: The files there are, the newest last.
        messages: Messages or frames written so far, also to files that were removed.
        octets: Bytes written so far, likewise.
    """

    def __init__(
        self,
        base: Path,
        ending: str,
        *,
        numbered: bool = False,
        split_ns: int = 0,
        split_bytes: int = 0,
        keep: int = 0,
        continues: bool = False,
        room: int | None = None,
    ) -> None:
        self._base = base
        self._ending = ending
        self._numbered = numbered
        self._split_ns = split_ns
        self._split_bytes = split_bytes
        self._keep = keep
        self._room = room
        self._number = 0
        self._file: RecordingFile | None = None
        self._began_ns = 0
        self.paths: list[Path] = []
        self.messages = 0
        self.octets = 0
        self._finished = 0, 0
        """Messages and bytes of all files but the present one."""
        if continues:
            self._adopt()

    @property
    def is_open(self) -> bool:
        """True if a file is being written."""
        return self._file is not None

    def open(self, make: OpenFile, time_ns: int) -> Path:
        """Close the present file and begin the next one, which *make* opens.

        Raises:
            DiskFullError: there is no room.
            EnvironmentalError: there is no folder.
            OSError: it cannot be made.
        """
        self.close(time_ns)
        if not self._base.parent.is_dir():
            raise EnvironmentalError(f"{self._base.parent}: no such folder: make it")
        path = self._next_path()
        self._check_room(path)
        self._file = make(path, time_ns)
        self._began_ns = time_ns
        self.paths.append(path)
        # The next file exists by now: a failure leaves one more, never one less.
        while self._keep and len(self.paths) > self._keep:
            self.paths.pop(0).unlink(missing_ok=True)
        return path

    def is_due(self, time_ns: int) -> bool:
        """Return whether the next block belongs to the next file."""
        file = self._file
        if file is None:
            return False
        by_time = self._split_ns and time_ns - self._began_ns >= self._split_ns
        return bool(by_time or (self._split_bytes and file.size >= self._split_bytes))

    def write(self, block: CapturedBlock) -> None:
        """Write a block to the present file.

        Raises:
            DiskFullError: there is no room; the file is closed, and whole.
            OSError: it cannot be written.
        """
        if self._file is not None:
            self._guard(lambda file: file.write(block))

    def add_gap(self, gap: Gap) -> None:
        """Write what is missing; raises as :meth:`write`."""
        self._guard(lambda file: file.add_gap(gap))

    def add_event(self, event: RecordingEvent) -> None:
        """Write an event; raises as :meth:`write`."""
        self._guard(lambda file: file.add_event(event))

    def flush(self) -> None:
        """Bring all to the disk, and check its room; raises as :meth:`write`."""
        if self._file is None:
            return
        self._guard(lambda file: file.flush())
        self._note_size()
        self._check_room(self.paths[-1])

    def close(self, time_ns: int) -> None:
        """End the present file, if there is one; raises as :meth:`write`."""
        if self._file is None:
            return
        self._guard(lambda file: file.close(time_ns))
        self._finish()

    def _guard(self, step: Callable[[RecordingFile], None]) -> None:
        file = self._file
        if file is None:
            return
        try:
            step(file)
        except OSError as exc:
            file.abandon()
            self._finish()
            if exc.errno in (errno.ENOSPC, errno.EDQUOT):
                raise DiskFullError(f"the disk is full: {self.paths[-1].parent}") from None
            raise
        self.messages = self._finished[0] + file.messages

    def _finish(self) -> None:
        self._file = None
        self._note_size()
        self._finished = self.messages, self.octets

    def _note_size(self) -> None:
        # Removed by somebody else, it still counts with what was known of it.
        with suppress(OSError):
            self.octets = self._finished[1] + self.paths[-1].stat().st_size

    def _adopt(self) -> None:
        base = self._base
        name = re.compile(rf"{re.escape(base.name)}-(\d{{4,9}}){re.escape(self._ending)}")
        try:
            paths = list(base.parent.iterdir())
        except OSError:  # the first file cannot be opened either, which has the reason
            paths = []
        matches = [(name.fullmatch(path.name), path) for path in paths]
        found = sorted((int(match[1]), path) for match, path in matches if match)
        self.paths = [path for _, path in found]
        self._number = found[-1][0] if found else 0

    def _next_path(self) -> Path:
        while True:
            self._number += 1
            # A single file has the name that its user has given.
            number = f"-{self._number:04d}" if self._numbered or self._number > 1 else ""
            path = self._base.with_name(f"{self._base.name}{number}{self._ending}")
            if not path.exists():
                return path

    def _check_room(self, path: Path) -> None:
        disk = os.statvfs(path.parent)
        # Checked before there is a file, and each second: a full disk would leave one unfinished.
        free, size = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
        wanted = room_on(size) if self._room is None else self._room
        if free < wanted:
            raise DiskFullError(
                f"the disk is nearly full: {path.parent} has {free / _MB:.0f} MB left of "
                f"{size / _MB:.0f} MB, and {wanted / _MB:.0f} MB stay free"
            )


def room_on(size: int) -> int:
    """Return the bytes that stay free on a disk of *size* bytes."""
    return ROOM_BYTES + min(size // ROOM_SHARE, ROOM_MOST)
