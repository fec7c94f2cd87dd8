"""Log of an appliance: lines of all its processes, as text, as JSON or to journald.

Nothing here waits: lines are dropped and counted while their reader is slow.
"""

from __future__ import annotations

import logging
import os
import select
import socket
from collections.abc import Iterator
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import msgspec

from eap.closeable import Closeable
from eap.runtime.log import JSON, VARIABLE, LogLine, line_of

_PIECE = select.PIPE_BUF
"""Bytes that a descriptor ready for writing takes at once."""
JOURNAL = "/run/systemd/journal/socket"
_PRIORITIES = {"error": 3, "warning": 4, "info": 6, "debug": 7}
"""Of syslog, by level."""
_DECODER = msgspec.json.Decoder(LogLine)


class LogForm(StrEnum):
    """Form of the log."""

    AUTO = "auto"
    """journal where stderr leads to journald, else text."""
    TEXT = "text"
    JSON = "json"
    """An object for each line."""
    JOURNAL = "journal"
    """Entries with fields, by the native protocol of journald."""


class Output:
    """Lines to a descriptor; those that it does not take now are dropped and counted.

    Args:
        fd: Where lines go.

    Attributes:
        dropped: How many, since the last line that was taken.
    """

    def __init__(self, fd: int) -> None:
        self.dropped = 0
        self._is_cut = False
        self._fd = fd
        self._poll = select.poll()
        self._poll.register(fd, select.POLLOUT)

    def write(self, line: str) -> None:
        """Write a line, behind a note on those that were left out before it."""
        if self.dropped:
            line = f"({self.dropped} lines dropped here: the reader was too slow)\n{line}"
        if self._is_cut:  # a full pipe or disk took a part of the line before: it ends there
            line = f"\n{line}"
        octets = f"{line}\n".encode("utf-8", "replace")
        for start in range(0, len(octets), _PIECE):
            piece = octets[start : start + _PIECE]
            taken = self._take(piece)
            if taken < len(piece):
                self.dropped += 1
                if written := octets[: start + taken]:
                    self._is_cut = not written.endswith(b"\n")
                return
        self.dropped = 0
        self._is_cut = False

    def _take(self, octets: bytes) -> int:
        """Write without waiting; return the number of bytes written."""
        # Not O_NONBLOCK: that flag belongs to the open file, which the shell and other programs
        # share.
        if not self._poll.poll(0):
            return 0
        try:
            return os.write(self._fd, octets)
        except OSError:  # the reader has gone, or the disk is full
            return 0


class Log(Closeable):
    """Log of this appliance.

    Args:
        output: Where text and JSON go.
        journal: Path of the socket of journald.
    """

    def __init__(self, output: Output, journal: str = JOURNAL) -> None:
        self._output = output
        self._path = journal
        self._form = LogForm.TEXT
        self._plant = ""
        self._journal: socket.socket | None = None

    def begin(self, form: LogForm, plant: str) -> None:
        """Choose the form, for this process and those that it starts.

        Args:
            form: Of the lines.
            plant: Field of the entries of journald.
        """
        if form is LogForm.AUTO:
            form = LogForm.JOURNAL if _is_journal(2) else LogForm.TEXT
        self._form, self._plant = form, plant
        if form is LogForm.TEXT:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = JSON
        if form is LogForm.JOURNAL:
            self._journal = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)

    def close(self) -> None:
        """Close the socket; lines that follow go to the output."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def pass_on(self, process: str, text: str) -> str:
        """Write a line that came from *process*; return it as text."""
        if self._form is LogForm.TEXT:
            self._output.write(text)
            return text
        try:
            line = _DECODER.decode(text)
        except (ValueError, RecursionError):
            # Not by logging, such as the reason of a start that fails.
            line = LogLine(_now(), "error", process, process, text.removeprefix(f"{process}: "))
        self.write(line)
        return f"{line.process}: {line.message}"

    def write(self, line: LogLine) -> None:
        """Write a line of this process, or of another one."""
        if self._form is LogForm.JSON:
            self._output.write(msgspec.json.encode(line).decode())
        elif self._form is LogForm.TEXT or not self._send(line):
            text = f"{line.process}: {line.message}"
            self._output.write(f"{text}\n{line.trace}" if line.trace else text)

    def _send(self, line: LogLine) -> bool:
        """Send an entry to journald; return False if it does not take it."""
        if self._journal is None:
            return False
        try:
            self._journal.sendto(b"".join(_fields(line, self._plant)), self._path)
        except OSError:  # too long for a datagram, or journald restarts
            return False
        return True


def _fields(line: LogLine, plant: str) -> Iterator[bytes]:
    text = f"{line.process}: {line.message}"
    fields = {
        "MESSAGE": f"{text}\n{line.trace}" if line.trace else text,
        "PRIORITY": str(_PRIORITIES.get(line.level, 6)),
        "SYSLOG_IDENTIFIER": "eapctl",
        "EAP_PLANT": plant,
        "EAP_PROCESS": line.process,
        "EAP_AREA": line.area,
    }
    for name, value in fields.items():
        octets = value.encode("utf-8", "replace")
        if b"\n" in octets:  # of several lines: with their length
            yield name.encode() + b"\n" + len(octets).to_bytes(8, "little") + octets + b"\n"
        else:
            yield name.encode() + b"=" + octets + b"\n"


def _is_journal(descriptor: int) -> bool:
    """Return whether *descriptor* leads to journald, as systemd says (systemd.exec(5))."""
    found = os.fstat(descriptor)
    named = os.environ.get("JOURNAL_STREAM", "")
    return named == f"{found.st_dev}:{found.st_ino}" and Path(JOURNAL).exists()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


LOG = Log(Output(2))
"""Of this process."""


class LogHandler(logging.Handler):
    """Log lines of the supervisor itself."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one."""
        LOG.write(line_of(record, "supervisor"))
