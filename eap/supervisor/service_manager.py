"""Readiness and watchdog of a service manager such as systemd (sd_notify(3)), without its library.

The manager restarts the whole appliance when the supervisor is silent.  So the supervisor writes
only while the processes that the plant needs run and the engine runs cycles.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress
from pathlib import Path

from eap.closeable import Closeable
from eap.pd.layout import WORDS_OFFSET
from eap.pd.words import StationWord

_CYCLE_OFFSET = WORDS_OFFSET + 8 * StationWord.CYCLE

logger = logging.getLogger(__name__)


class ServiceManager(Closeable):
    """Connection to the service manager that started this process, if one did.

    Args:
        environment: NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID are taken out of it, because they
            are not meant for other processes.
    """

    def __init__(self, environment: MutableMapping[str, str]) -> None:
        path = environment.pop("NOTIFY_SOCKET", "")
        limit_us = environment.pop("WATCHDOG_USEC", "")
        owner = environment.pop("WATCHDOG_PID", "")
        self._socket: socket.socket | None = None
        self._period_ns = 0
        self._next_ns = 0
        self._was_alive = True
        if path.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            self._address = f"\0{path[1:]}" if path[0] == "@" else path
            if limit_us.isdecimal() and owner in {"", str(os.getpid())}:
                # Thrice in the limit: one that comes late is no reason for a restart.
                self._period_ns = int(limit_us) * 1000 // 3

    @property
    def next_ns(self) -> int | None:
        """Time of the next :meth:`check`; None without a watchdog."""
        return self._next_ns if self._period_ns else None

    def notify(self, **fields: str) -> None:
        """Report, such as ``READY="1"``; a manager that does not read delays nothing."""
        if self._socket is not None:
            text = "\n".join(f"{name}={value}" for name, value in fields.items())
            with suppress(OSError):
                self._socket.sendto(text.encode(), self._address)

    def check(self, now_ns: int, *, is_alive: bool) -> None:
        """Restart the time of the watchdog, if the appliance is alive."""
        self._next_ns = now_ns + self._period_ns
        if is_alive:
            self.notify(WATCHDOG="1")
        elif self._was_alive:  # once: the log of a service that hangs has this as its last line
            logger.error("no sign of life for the watchdog: engine or services do not run")
        self._was_alive = is_alive

    def close(self) -> None:
        """Report that the appliance ends."""
        self.notify(STOPPING="1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class CycleProgress:
    """Progress of the engine, seen by the cycle counter of one station in its process image.

    Args:
        image: The station's.
        cycle_us: Its device cycle.
    """

    def __init__(self, image: Path, cycle_us: int) -> None:
        self._image = image
        self._limit_ns = 3 * 1000 * cycle_us
        self._cycle = -1
        self._since_ns = 0

    def is_alive(self, now_ns: int) -> bool:
        """Return whether there was a cycle since the call before, or can have been none yet."""
        cycle = self._read()
        if cycle != self._cycle:
            self._cycle, self._since_ns = cycle, now_ns
            return True
        return now_ns - self._since_ns <= self._limit_ns

    def _read(self) -> int:
        try:
            with self._image.open("rb", buffering=0) as file:
                return int.from_bytes(os.pread(file.fileno(), 8, _CYCLE_OFFSET), "little")
        except OSError:
            return -1  # there is none before the first start of the engine
