"""Frames that the kernel sorted to services: type 5, and what belongs nowhere.

What is not taken is counted under the reason.  What had waited in a socket since before this
process started is stale, whatever it is: its sender has long given up.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Protocol, TypeAlias

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.pd.link import FrameOrigin
from eap.runtime.discards import DiscardCounters, Refusal

_MAILBOX = FrameType.MAILBOX.value  # a plain number: members of enums are slow


QUICK_NS = 120_000
"""Frames that come within this time after the last was answered are quick."""
PATIENCE_NS = 60_000
"""How long is watched for the next of them."""
MOST_FRAMES = 32
"""That are taken so before others have their turn."""
TRUST = 2
"""How often in a row that may be in vain: who was quick may have been interrupted."""
MOST_REST = 1024
"""Frames that are not waited for, once many were waited for in vain."""


class DrainedChannel(Protocol):
    """What services needs of a UDP or an Ethernet channel."""

    def drain(self, now_ns: int) -> int:
        """Hand what waits to the takers; return how many frames there were."""

    def fileno(self) -> int:
        """Return the descriptor to watch."""


MailboxTaker: TypeAlias = Callable[[memoryview, int, int, FrameOrigin], Refusal | None]
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

    def take(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> None:
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
    patient = PatientDrain(channel)
    asyncio.get_running_loop().add_reader(channel.fileno(), patient.drain)
    patient.drain()


class PatientDrain:
    """Drains a channel, and looks again for a while where the next frame is likely to be near.

    Who waits for each answer before asking again does so at once: the next frame is there sooner
    than a process falls asleep, is woken and finds its way through an event loop, which takes as
    long as to answer.  So while frames come that quickly the channel is watched, for some
    microseconds after each and for some frames in all, because others wait for the loop.

    Where the sender shares the processor he cannot go on before this gives up.  So each time in
    vain the channel is not watched for twice as many frames.

    Args:
        channel: What is drained.
        clock: The monotonic clock, in nanoseconds.
    """

    def __init__(self, channel: DrainedChannel, clock: Callable[[], int] = monotonic_ns) -> None:
        self._channel = channel
        self._clock = clock
        self._answered_ns = clock() - QUICK_NS
        self._trust = 0
        self._resting = 0
        self._rest = 1

    def drain(self) -> None:
        """Take what waits; and what comes, if this came quickly after what was taken last."""
        channel, clock = self._channel, self._clock
        now_ns = clock()
        is_quick = now_ns - self._answered_ns < QUICK_NS
        taken = channel.drain(now_ns)
        self._answered_ns = now_ns = clock()
        if self._resting:
            self._resting -= 1
        elif is_quick or self._trust:
            self._watch(taken, now_ns)

    def _watch(self, taken: int, now_ns: int) -> None:
        """Look for more, after *taken* frames."""
        channel, clock = self._channel, self._clock
        while taken < MOST_FRAMES:
            if now_ns - self._answered_ns > PATIENCE_NS:
                self._note_vain()
                return
            found = channel.drain(now_ns)
            now_ns = clock()
            if found:
                taken += found
                self._answered_ns, self._trust, self._rest = now_ns, TRUST, 1

    def _note_vain(self) -> None:
        """Remember that nothing came; of somebody who was quick until now that says little."""
        if self._trust:
            self._trust -= 1
        else:
            self._resting, self._rest = self._rest, min(2 * self._rest, MOST_REST)
