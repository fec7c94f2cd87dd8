"""The file of a ring of frames: one for each appliance, mapped by its engine and by readers.

The engine makes it with the header alone.  The first reader gives it room for the ring; that takes
time, which no cycle has.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from pathlib import Path

from eap.closeable import Closeable
from eap.errors import EnvironmentalError, ImageError
from eap.pd.framering import HEADER_SIZE, FrameRingReader, FrameRingWriter, RingHeader

CAPACITY = 16 << 20
"""Bytes of the ring: 2 s of the frames of 15 stations with 54 PDs of 600 bytes at 100 Hz."""


class _RingFile(Closeable):
    """The open file with its header mapped."""

    def __init__(self, path: Path, flags: int) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | flags, 0o600)
        try:
            if flags & os.O_CREAT:
                os.posix_fallocate(self._fd, 0, HEADER_SIZE)
            self._view = memoryview(mmap.mmap(self._fd, HEADER_SIZE))
        except (OSError, ValueError):
            os.close(self._fd)
            raise

    def close(self) -> None:
        """Close the descriptor; the mapping goes with the last view of it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _map(self, capacity: int) -> memoryview:
        return memoryview(mmap.mmap(self._fd, HEADER_SIZE + capacity))


class FrameRingFile(_RingFile):
    """The engine's side.

    Attributes:
        header: Of the ring; the counts of an earlier engine continue.

    Raises:
        EnvironmentalError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        try:
            super().__init__(path, os.O_CREAT)
        except OSError as exc:
            raise EnvironmentalError(
                f"{path}: the ring of frames cannot be made: {exc.strerror}"
            ) from None
        self.header = RingHeader.format(self._view)

    def writer(self) -> FrameRingWriter | None:
        """Map the ring and return its writer; None as long as no reader has given it room."""
        capacity = self.header.capacity
        # A file that is shorter than it says would be a SIGBUS in the cycle.  Mapping takes
        # microseconds: the engine locks pages only when it touches them (realtime.py).
        if not capacity or os.fstat(self._fd).st_size < HEADER_SIZE + capacity:
            return None
        return FrameRingWriter(self.header, self._map(capacity))


class AttachedRing(_RingFile):
    """The side of a reader, from the frame on that is recorded next.

    Args:
        path: Of the file.
        capacity: Bytes of the ring, if it has none yet.

    Attributes:
        reader: Reads the ring.

    Raises:
        ImageError: there is no such file, or it is of another release.
        EnvironmentalError: there is no memory for the ring.
    """

    def __init__(self, path: Path, capacity: int = CAPACITY) -> None:
        try:
            super().__init__(path, 0)
        except (OSError, ValueError) as exc:
            raise ImageError(f"{path}: no ring of frames: {exc}") from None
        try:
            header = RingHeader(self._view)
            self._make_room(path, header, capacity)
            self.reader = FrameRingReader(header, self._map(header.capacity))
        except BaseException:
            self.close()
            raise

    def _make_room(self, path: Path, header: RingHeader, capacity: int) -> None:
        # Two readers may be the first one; the lock ends with the descriptor.
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        try:
            if not header.capacity:
                os.posix_fallocate(self._fd, 0, HEADER_SIZE + capacity)
                header.capacity = capacity
        except OSError as exc:
            raise EnvironmentalError(
                f"{path}: no room for {capacity >> 20} MB of frames: {exc.strerror}"
            ) from None
        finally:
            fcntl.flock(self._fd, fcntl.LOCK_UN)
