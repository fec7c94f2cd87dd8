"""Times at which the error counters of ports have grown.

The counters of a slave controller tell how many errors there were, never when.  They are read once
a second, so that a cable that was mended is told from one that still breaks frames.
"""

from __future__ import annotations

from typing import NamedTuple

from devicebus.errors import FrameLostError
from devicebus.master.access import fprd
from devicebus.master.bus import Bus
from devicebus.master.diagnosis import COUNTERS, port_counters
from devicebus.master.procedure import Procedure
from devicebus.wire.register import Register

PERIOD_NS = 1_000_000_000
_PER_STEP = 15


class Growth(NamedTuple):
    """First and last time at which more errors were seen at a port."""

    since_ns: int
    until_ns: int


class PortErrorLog:
    """When the counters of each port have grown, by station address and port."""

    def __init__(self) -> None:
        self._counters: dict[int, tuple[int, ...]] = {}
        self._growth: dict[int, dict[int, Growth]] = {}

    def of(self, station: int) -> dict[int, Growth]:
        """Return by port when errors were seen; a port that was quiet is not there."""
        return self._growth.get(station, {})

    def clear(self) -> None:
        """Forget all times; what the counters show now is not new."""
        self._growth.clear()

    def take(self, station: int, octets: bytes, now_ns: int) -> None:
        """Take the counters of a slave as they are now.

        What they show at the first look has happened at an unknown time.  Counters that are smaller
        than before were cleared, or the slave was switched off: older times go with them.
        """
        counters = port_counters(octets)
        before = self._counters.get(station, counters)
        self._counters[station] = counters
        if any(now < old for now, old in zip(counters, before, strict=True)):
            self._growth.pop(station, None)
            before = (0,) * len(counters)
        for port, (now, old) in enumerate(zip(counters, before, strict=True)):
            if now > old:
                ports = self._growth.setdefault(station, {})
                first = ports[port].since_ns if port in ports else now_ns
                ports[port] = Growth(first, now_ns)


def look_at_errors(bus: Bus, log: PortErrorLog) -> Procedure[None]:
    """Read the error counters of all slaves that answer."""
    stations = [unit.station for unit in bus.units.values() if not unit.is_lost]
    for start in range(0, len(stations), _PER_STEP):
        part = stations[start : start + _PER_STEP]
        try:
            replies, now_ns = yield [fprd(at, Register.RX_ERROR, COUNTERS, tries=1) for at in part]
        except FrameLostError:
            return  # the next look comes soon
        for station, reply in zip(part, replies, strict=True):
            if reply.wkc:
                log.take(station, reply.data, now_ns)
