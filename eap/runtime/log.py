"""Log lines of the processes of an appliance: text, or JSON that the supervisor passes on.

A process writes to stderr, which is a pipe to the supervisor.  EAP_LOG_FORM says which form the
supervisor expects; without it, lines are text.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import msgspec

VARIABLE: Final = "EAP_LOG_FORM"
JSON: Final = "json"
_PACKAGES_WITH_AREAS = frozenset(("services", "bridges"))


class LogLine(msgspec.Struct, frozen=True, omit_defaults=True):
    """One log line as JSON."""

    time: str
    """ISO 8601 with milliseconds and time zone (UTC)."""
    level: str
    """debug, info, warning or error."""
    process: str
    area: str
    """Package that wrote it, such as routing or transports."""
    message: str
    trace: str = ""
    """Traceback of an unexpected error."""


_FORMATTER = logging.Formatter()


def line_of(record: logging.LogRecord, process: str) -> LogLine:
    """Return the line of a record that *process* wrote."""
    when = datetime.fromtimestamp(record.created, UTC)
    return LogLine(
        time=when.isoformat(timespec="milliseconds"),
        level="error" if record.levelno >= logging.ERROR else record.levelname.lower(),
        process=process,
        area=area_of(record.name),
        message=record.getMessage(),
        trace=_FORMATTER.formatException(record.exc_info) if record.exc_info else "",
    )


def area_of(logger: str) -> str:
    """Return the area of a logger's name: ``eap.services.routing.service`` is routing."""
    parts = logger.split(".")
    if parts[0] != "eap" or len(parts) == 1:
        return parts[0]
    is_divided = parts[1] in _PACKAGES_WITH_AREAS and len(parts) > 2
    return parts[2] if is_divided else parts[1]


class _JsonFormatter(logging.Formatter):
    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        return msgspec.json.encode(line_of(record, self._process)).decode()


def start_logging(process: str, handler: logging.Handler | None = None) -> None:
    """Log to stderr, or to *handler*, in the form that the supervisor expects.

    Args:
        process: Name of this process, as in ``status``.
        handler: Where lines go.
    """
    handler = handler or logging.StreamHandler()
    is_json = os.environ.get(VARIABLE) == JSON
    text = logging.Formatter(f"{process}: %(message)s")
    handler.setFormatter(_JsonFormatter(process) if is_json else text)
    logging.basicConfig(level=logging.INFO, handlers=[handler])


class LevelFile:
    """File with the log levels of optional processes, in the *folder* of their appliance.

    Services writes it, and they look at it: so they need no connection for it.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "log.levels"
        self._changed_ns = 0

    def read(self) -> dict[str, str]:
        """Return the level of each process that has another one than info."""
        # Bytes that are no UTF-8 raise UnicodeDecodeError, which is none of msgspec's errors.
        with suppress(OSError, ValueError):
            return msgspec.json.decode(self._path.read_bytes(), type=dict[str, str])
        return {}

    def write(self, levels: Mapping[str, str]) -> None:
        """Replace the levels in one step.

        Raises:
            OSError: they cannot be kept.
        """
        temporary = self._path.with_suffix(".new")
        temporary.write_bytes(msgspec.json.encode(levels))
        temporary.replace(self._path)

    def follow(self, process: str) -> None:
        """Set the level of this *process*, if the file has changed since the last call."""
        try:
            changed_ns = self._path.stat().st_mtime_ns
        except OSError:
            return
        if changed_ns != self._changed_ns:
            self._changed_ns = changed_ns
            level = self.read().get(process, "info").upper()
            if level in logging.getLevelNamesMapping():
                logging.getLogger("eap").setLevel(level)
