"""The cycle of all stations of one process: who is due when."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from heapq import heapify, heapreplace

from eap.pd.link import Channel
from eap.pd.station import Station
from eap.pd.words import StationWord


class Engine:
    """Runs each station when its cycle is due; a cycle it comes too late for is left out."""

    def __init__(self, stations: Sequence[Station]) -> None:
        self._stations = stations
        self._arrivals: list[Channel] = []
        self._due: list[tuple[int, int]] = []

    def drain_on_arrival(self, channels: Iterable[Channel]) -> None:
        """Take what these channels receive as soon as :meth:`receive` is called."""
        self._arrivals.extend(channels)

    def start(self, now_ns: int) -> None:
        """Bring all stations to Op."""
        self._due = [(station.start(now_ns), index) for index, station in enumerate(self._stations)]
        heapify(self._due)

    def stop(self) -> None:
        """Bring all stations out of Op."""
        for station in self._stations:
            station.stop()

    def next_timeout(self) -> int:
        """Return when the next station is due, on the clock that gives ``now_ns``."""
        return self._due[0][0]

    def handle_timeout(self, now_ns: int) -> None:
        """Run the station that is due first; early calls are harmless.

        One a call, so that whoever calls reads the clock again before the next.
        """
        due_ns, index = self._due[0]
        if due_ns > now_ns:
            return
        station = self._stations[index]
        station.cycle(due_ns, now_ns)
        following_ns = due_ns + station.cycle_ns
        if following_ns < now_ns:
            missed = -(-(now_ns - following_ns) // station.cycle_ns)
            station.image.words[StationWord.OVERRUNS] += missed
            following_ns += missed * station.cycle_ns
        heapreplace(self._due, (following_ns, index))

    def receive(self, now_ns: int) -> None:
        """Take pending frames between cycles, of the channels that asked for it."""
        for channel in self._arrivals:
            channel.drain(now_ns)
