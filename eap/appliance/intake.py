"""Frames that the kernel sorted to services: counted under the reason for which they are not taken.

Type 5 belongs here; nothing in this release answers it.  What had waited in a socket since before
this process started is stale, whatever it is: its sender has long given up.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from time import monotonic_ns
from typing import Protocol

from eap.appliance.discards import DiscardCounters, Refusal
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.pd.link import Origin


class DrainedChannel(Protocol):
    """What services needs of a UDP or an Ethernet channel."""

    def drain(self, now_ns: int) -> int:
        """Hand what waits to the takers; return how many frames there were."""

    def fileno(self) -> int:
        """Return the descriptor to watch."""


class FrameIntake:
    """Takes the frames of one socket for the *stations* that listen there."""

    def __init__(self, stations: Sequence[str], counters: DiscardCounters, from_ns: int) -> None:
        self._stations = stations
        self._counters = counters
        self._from_ns = from_ns

    def take(self, data: memoryview, size: int, at_ns: int, origin: Origin) -> None:
        """Count one frame that arrived at *at_ns* on the monotonic clock, whoever sent it."""
        del origin
        reason = Refusal.STALE if at_ns < self._from_ns else _reason(data, size)
        for station in self._stations:
            self._counters.count(station, reason)


def watch_channel(channel: DrainedChannel) -> None:
    """Drain *channel* now and whenever something arrives, as long as the running loop lives."""

    def drain() -> None:
        channel.drain(monotonic_ns())

    asyncio.get_running_loop().add_reader(channel.fileno(), drain)
    drain()


def _reason(data: memoryview, size: int) -> Refusal:
    if size < EtherCatHeader.SIZE:
        return Refusal.TRUNCATED
    if EtherCatHeader.decode(data).type == FrameType.MAILBOX:
        return Refusal.MAILBOX
    return Refusal.WRONG_TYPE
