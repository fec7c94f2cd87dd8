"""Counters of frames and connections dropped before any subscription, in a file of the process."""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum, auto
from pathlib import Path

from eap.closeable import Closeable
from eap.errors import EnvironmentalError


class DropReason(StrEnum):
    """Reason for which a frame or a connection was dropped."""

    MAILBOX = auto()
    """Type 5 that is no AoE request, to a station without a bus or to many."""
    STALE = auto()
    """It had waited in its socket since before services started."""
    WRONG_TYPE = auto()
    """Neither type 4 nor type 5."""
    TRUNCATED = auto()
    """Shorter than its headers say."""
    TCP_OFF = auto()
    """A type-4 connection to a station without a port with ``tcp: true``."""
    TCP_SLOW = auto()
    """A connection left a frame unfinished, or took no answers, and was closed."""
    TCP_EVICTED = auto()
    """A connection with process data made room for another one."""
    TCP_FULL = auto()
    """More connections than there is room for."""
    TCP_TYPE = auto()
    """A connection that continued with a frame of another type, and was closed."""
    ENGINE_BUSY = auto()
    """The engine did not take a connection that was meant for it."""
    OTHER_VLAN = auto()
    """An Ethernet frame of a VLAN that no port names."""
    LOCAL_OVERFLOW = auto()
    """Stations on one Ethernet interface sent each other more than they took."""
    AMS_FULL = auto()
    """More AMS/TCP connections than there is room for."""
    AMS_TYPE = auto()
    """An AMS/TCP connection carried data that is no AMS packet, and was closed."""
    AMS_LENGTH = auto()
    """An AMS packet too long, or of another length than its header says; it was answered so."""
    AMS_SLOW = auto()
    """An AMS/TCP connection left a packet unfinished, or took no answers, and was closed."""
    AMS_UNASKED = auto()
    """An answer by AMS/TCP without a pending request."""
    AMS_DISCOVERY = auto()
    """A datagram to UDP 48899 with an unknown request."""
    GATEWAY_OFF = auto()
    """A mailbox message, while the gateway that it was for is stopped."""
    MQTT_TOPIC = auto()
    """A message by MQTT on an unknown topic, or on a topic that its sender must not use."""
    MQTT_BROKEN = auto()
    """A message by MQTT that is neither a packet nor the description of a router."""
    MQTT_FULL = auto()
    """One router or one message by MQTT more than there is room for."""
    TLS_FULL = auto()
    """More connections to Secure ADS than there is room for, or faster than is allowed."""
    TLS_HANDSHAKE = auto()
    """A connection to Secure ADS began no TLS, or none with methods and keys that fit."""
    TLS_SLOW = auto()
    """A connection by Secure ADS did not complete its handshake in time."""
    TLS_CERTIFICATE = auto()
    """A certificate by Secure ADS was missing, expired, or of an authority that is not trusted."""
    TLS_FINGERPRINT = auto()
    """A self-signed certificate by Secure ADS had another fingerprint than the known ones."""
    TLS_NAME = auto()
    """A certificate by Secure ADS was for another host, or named nobody."""
    TLS_VERSION = auto()
    """Secure ADS of another version."""
    TLS_INFO = auto()
    """A connection by Secure ADS that did not begin with its message, or broke off in it."""
    TLS_USER = auto()
    """A request for a route by Secure ADS with a wrong user or password, or that was refused."""


_DROP_REASONS = tuple(DropReason)
_COLUMN = {reason: index for index, reason in enumerate(_DROP_REASONS)}


class DropCounters(Closeable):
    """One 64-bit word for each station and reason; each process has its own file.

    Raises:
        EnvironmentalError: the file cannot be made.
    """

    def __init__(self, path: Path, stations: Sequence[str]) -> None:
        size = 8 * len(_DROP_REASONS) * max(1, len(stations))
        try:
            # Not truncated: the counters of a process that was restarted continue.
            with path.open("ab") as file:
                os.posix_fallocate(file.fileno(), 0, size)  # no SIGBUS on a full disk
                os.ftruncate(file.fileno(), size)
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), size)
        except OSError as exc:
            raise EnvironmentalError(
                f"{path}: the counters cannot be made: {exc.strerror}"
            ) from None
        self._words = memoryview(self._map).cast("Q")
        self._row = {name: row * len(_DROP_REASONS) for row, name in enumerate(stations)}

    def count(self, station: str, reason: DropReason, number: int = 1) -> None:
        """Add *number* to one counter."""
        self._words[self._row[station] + _COLUMN[reason]] += number

    def stats(self) -> dict[str, dict[str, int]]:
        """Return all counters that are not zero, by station."""
        return {
            name: {
                str(reason): self._words[row + column]
                for reason, column in _COLUMN.items()
                if self._words[row + column]
            }
            for name, row in self._row.items()
        }

    def close(self) -> None:
        """Close the file."""
        self._words.release()
        self._map.close()


class DropCounterFeed:
    """Adds the counts of a driver, by name in a dict, to *counters* of all *stations*.

    *reason_of* maps a name to its counter, None for none.
    """

    def __init__(
        self,
        counters: DropCounters,
        stations: Sequence[str],
        source: Mapping[str, int],
        reason_of: Callable[[str], DropReason | None],
    ) -> None:
        self._counters = counters
        self._stations = stations
        self._source = source
        self._reason_of = reason_of
        self._seen: dict[str, int] = {}

    def publish(self) -> None:
        """Add the counts since the last call."""
        for name, total in self._source.items():
            # Differences: the file holds counts of earlier processes, the driver those since its
            # start.
            grown = total - self._seen.get(name, 0)
            if not grown:
                continue
            self._seen[name] = total
            if reason := self._reason_of(name):
                for station in self._stations:
                    self._counters.count(station, reason, grown)
