"""File of the audit: whole lines at its end, or none; what is full goes aside.

Rule 1: lines are appended as a whole.  Where a disk takes only a part, that part is taken back.
Rule 2: a line that somebody else broke off (a lost power supply, another program) is ended first.
Rule 3: appliances of one plant share the file; who writes holds its lock.
"""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from pathlib import Path
from time import monotonic

MAX_BYTES = 8 << 20
"""Of the file before it is put aside."""
KEPT = 4
"""Older files."""
_FLAGS = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
LOCK_S = 0.2
"""Longest wait for the lock, which others hold as long as it takes to write a few lines.

All clients of the process wait meanwhile, so after one wait in vain there is none until the lock
was had again: another process may be stopped while it holds it.
"""


class AuditFile:
    """The file; older ones lie beside it, with ``.1`` and so on behind their names.

    Attributes:
        path: Of the file, in a folder that only its owner may enter.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._wait_s = LOCK_S

    def append(self, lines: bytes) -> None:
        """Append *lines*, all of them or nothing.

        Raises:
            OSError: they cannot be written; the file is as it was.
        """
        fd = self._open_locked()
        try:
            size = os.fstat(fd).st_size
            if size and os.pread(fd, 1, size - 1) != b"\n":
                lines = b"\n" + lines
            try:
                _write_all(fd, lines)
            except OSError:
                os.ftruncate(fd, size)
                raise
            if size + len(lines) >= MAX_BYTES:
                with suppress(OSError):  # the lines are written; the next ones try it again
                    self._put_aside()
        finally:
            os.close(fd)

    def _open_locked(self) -> int:
        """Open the file and lock it."""
        deadline_s = monotonic() + self._wait_s
        while (fd := self._try_lock()) < 0:
            if monotonic() >= deadline_s:
                self._wait_s = 0.0
                raise OSError(errno.EAGAIN, "another process holds its lock")
            os.sched_yield()
        self._wait_s = LOCK_S
        return fd

    def _try_lock(self) -> int:
        """Return the locked file, -1 if another process has its lock or has just moved it away."""
        fd = self._open()
        is_locked = False
        try:
            with suppress(BlockingIOError, FileNotFoundError):
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                is_locked = os.path.samestat(os.fstat(fd), self.path.stat())
        finally:
            if not is_locked:
                os.close(fd)
        return fd if is_locked else -1

    def _open(self) -> int:
        try:
            return os.open(self.path, _FLAGS, 0o640)
        except FileNotFoundError:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.open(self.path, _FLAGS, 0o640)

    def _put_aside(self) -> None:
        names = [self.path.with_name(f"{self.path.name}.{number}") for number in range(1, KEPT + 1)]
        for older, newer in zip(reversed(names[1:]), reversed(names[:-1]), strict=True):
            if newer.exists():
                newer.replace(older)
        self.path.replace(names[0])


def _write_all(fd: int, data: bytes) -> None:
    """Write *data*; the rest of a short write is tried again, for the reason why it was short."""
    while data:
        data = data[os.write(fd, data) :]
