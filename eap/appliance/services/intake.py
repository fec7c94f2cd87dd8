"""Frames that the kernel sorted to services: type 5, and what belongs nowhere.

What is not taken is counted under the reason.  What had waited in a socket since before this
process started is stale, whatever it is: its sender has long given up.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Protocol, TypeAlias

from eap.appliance.discards import DiscardCounters, Refusal
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.pd.link import Origin

_MAILBOX = FrameType.MAILBOX.value  # a plain number: members of enums are slow


class DrainedChannel(Protocol):
    """What services needs of a UDP or an Ethernet channel."""

    def drain(self, now_ns: int) -> int:
        """Hand what waits to the takers; return how many frames there were."""

    def fileno(self) -> int:
        """Return the descriptor to watch."""


MailboxTaker: TypeAlias = Callable[[memoryview, int, int, Origin], Refusal | None]
"""Takes a frame of type 5 as a Taker does; returns why not if it does not."""


class FrameIntake:
    """Takes the frames of one socket for the *stations* that listen there.

    Args:
        stations: At which is counted what is not taken.
        counters: Where.
        from_ns: Since when this process runs, on the monotonic clock.
        mailbox: Takes type 5.
    """

    def __init__(
        self,
        stations: Sequence[str],
        counters: DiscardCounters,
        from_ns: int,
        mailbox: MailboxTaker,
    ) -> None:
        self._stations = stations
        self._counters = counters
        self._from_ns = from_ns
        self.mailbox = mailbox

    def take(self, data: memoryview, size: int, at_ns: int, origin: Origin) -> None:
        """Take, or count, one frame that arrived at *at_ns* on the monotonic clock."""
        if at_ns < self._from_ns:
            reason: Refusal | None = Refusal.STALE
        elif size < EtherCatHeader.SIZE:
            reason = Refusal.TRUNCATED
        elif data[1] >> 4 == _MAILBOX:  # the four upper bits of the header
            reason = self.mailbox(data, size, at_ns, origin)
        else:
            reason = Refusal.WRONG_TYPE
        if reason is not None:
            for station in self._stations:
                self._counters.count(station, reason)


def watch_channel(channel: DrainedChannel) -> None:
    """Drain *channel* now and whenever something arrives, as long as the running loop lives."""

    def drain() -> None:
        channel.drain(monotonic_ns())

    asyncio.get_running_loop().add_reader(channel.fileno(), drain)
    drain()
