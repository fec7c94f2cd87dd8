"""What people read of an appliance, on stderr: lines that never wait for who reads them.

A terminal can be held (Ctrl-S), and a pipe may have a reader that has fallen asleep.  A supervisor
that waited for them could not start a process again, and services, whose lines go through its
hands, would stand still with it.
"""

from __future__ import annotations

import logging
import os
import select

_PIECE = select.PIPE_BUF
"""Octets that whatever is ready to be written takes at once."""


class Output:
    """Lines to a descriptor; those that it does not take now are left out, and counted.

    Args:
        fd: Where lines go.

    Attributes:
        left_out: How many, since the last line that was taken.
    """

    def __init__(self, fd: int) -> None:
        self.left_out = 0
        self._is_cut = False
        self._fd = fd
        self._poll = select.poll()
        self._poll.register(fd, select.POLLOUT)

    def write(self, line: str) -> None:
        """Write a line, behind a note on those that were left out before it."""
        if self.left_out:
            line = f"({self.left_out} lines left out here, which nobody took)\n{line}"
        if self._is_cut:  # a full pipe or disk took a part of the line before: it ends there
            line = f"\n{line}"
        octets = f"{line}\n".encode("utf-8", "replace")
        for start in range(0, len(octets), _PIECE):
            piece = octets[start : start + _PIECE]
            taken = self._take(piece)
            if taken < len(piece):
                self.left_out += 1
                if written := octets[: start + taken]:
                    self._is_cut = not written.endswith(b"\n")
                return
        self.left_out = 0
        self._is_cut = False

    def _take(self, octets: bytes) -> int:
        """Write what is taken at once; return how much that was."""
        if not self._poll.poll(0):
            return 0
        try:
            return os.write(self._fd, octets)
        except OSError:  # the reader has gone, or the disk is full
            return 0


STDERR = Output(2)
"""Of this process."""


class OutputHandler(logging.Handler):
    """Log lines of the supervisor itself."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one."""
        STDERR.write(self.format(record))
