"""Rates of what peers cause: requests, log lines and audit lines, in bursts and over time."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple


class Allowance:
    """Room for *burst* at once, which comes back at *per_s* a second."""

    def __init__(self, burst: int, per_s: float, now_s: float) -> None:
        self._burst = burst
        self._per_s = per_s
        self._left = float(burst)
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Say whether there is room for one more, and take it."""
        passed_s = max(0.0, now_s - self._at_s)
        self._at_s = now_s
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Rate(NamedTuple):
    """A rate limit: *burst* at once, and *per_s* a second for long."""

    burst: int
    per_s: float


class SourceRates(NamedTuple):
    """Rates of a :class:`SourceRateLimiter`."""

    source: Rate
    """Of each source by itself."""
    known: Rate
    """Of all sources together that were seen before."""
    new: Rate
    """Of all sources together that were not: senders of datagrams can invent any number of them."""
    local: Rate
    """Of this host, which no other source takes anything from."""


class SourceRateLimiter:
    """Rate limit by source address, within a limit for all.

    A source that uses up its own rate, or all that known sources have together, leaves the rates of
    new sources and of this host as they are.

    Args:
        rates: Of one source and of all.
        max_sources: Sources that are remembered; the one silent for longest is forgotten.
        now_s: The time, in seconds.
    """

    def __init__(self, rates: SourceRates, max_sources: int, now_s: float) -> None:
        self._rate = rates.source
        self._max_sources = max_sources
        self._known = Allowance(*rates.known, now_s)
        self._new = Allowance(*rates.new, now_s)
        self._local = Allowance(*rates.local, now_s)
        self._sources: OrderedDict[str, Allowance] = OrderedDict()

    def take_local(self, now_s: float) -> bool:
        """Take one for this host; return whether its rate allows it."""
        return self._local.take(now_s)

    def take(self, source: str, now_s: float) -> bool:
        """Take one for *source*; return whether its own rate and that of all allow it."""
        own = self._sources.get(source)
        if own is not None:
            self._sources.move_to_end(source)
            return own.take(now_s) and self._known.take(now_s)
        if not self._new.take(now_s):
            return False
        if len(self._sources) >= self._max_sources:
            self._sources.popitem(last=False)
        own = self._sources[source] = Allowance(*self._rate, now_s)
        return own.take(now_s)
