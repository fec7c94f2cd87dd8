"""Schedule of the cycles of all stations of one process, and of the timers of their buses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from heapq import heapify, heapreplace
from types import MappingProxyType

from eap.pd.device import DeviceState
from eap.pd.link import CyclicBus, FrameChannel
from eap.pd.station import Station
from eap.pd.words import StationWord

SOON_NS = 1_000_000_000
"""The start of the engine does not wait for a station whose cycle is longer."""

_BEHIND_NS = int(StationWord.BEHIND_NS)
_LATER_NS, _EARLIER_NS = 1000, 4000
"""Changes of a station's place in a cycle: so that one cycle in five begins before its place."""


class Engine:
    """Runs each station when its cycle is due, and skips a cycle for which it is too late.

    Stations that are due at the same moment are a group: one wake-up serves them, one after the
    other, shorter cycles first.  The place of a station is its usual begin after the first one,
    from which its lateness counts: what is the same in each cycle is no jitter.
    """

    def __init__(self, stations: Sequence[Station]) -> None:
        self._stations = list(stations)
        self._arrivals: list[FrameChannel] = []
        self._buses: list[CyclicBus] = []
        self._others: list[CyclicBus] = []
        self._due: list[tuple[int, int, int]] = []
        """Due time, cycle time and index of each station."""
        self._moment_ns = self._begun_ns = 0
        """Due time and begin of the group that runs."""
        self.is_within_group = False
        """True as long as stations of the group that runs are due."""

    def drain_on_arrival(self, channels: Iterable[FrameChannel]) -> None:
        """Drain these channels as soon as :meth:`receive` is called."""
        self._arrivals.extend(channels)

    def start(self, now_ns: int, states: Mapping[str, DeviceState] = MappingProxyType({})) -> None:
        """Bring all stations, with their present buses, to Op or to their state in *states*."""
        self._find_buses()
        self._due = [
            (
                station.start(now_ns, states.get(station.spec.name, DeviceState.OP)),
                station.cycle_ns,
                index,
            )
            for index, station in enumerate(self._stations)
        ]
        heapify(self._due)

    @property
    def is_under_way(self) -> bool:
        """True if every station has run a cycle since the start, or has one beyond SOON_NS."""
        return all(each.has_run or each.cycle_ns > SOON_NS for each in self._stations)

    def run_also(self, buses: Iterable[CyclicBus]) -> None:
        """Run the timers of *buses* that no station has, and of no others without a station."""
        self._others = list(buses)
        self._find_buses()

    def _find_buses(self) -> None:
        self._buses = [bus for station in self._stations for bus in station.buses]
        self._buses += self._others

    def replace(self, old: Station, new: Station, now_ns: int) -> None:
        """Run *new* in the place of *old*; its cycle counter continues."""
        # The index in `_due` stays valid, so the heap is untouched unless the cycle time changes.
        index = self._stations.index(old)
        self._stations[index] = new
        self._find_buses()
        if new.cycle_ns != old.cycle_ns:
            by_station = {number: due_ns for due_ns, _, number in self._due}
            # Counted from the last cycle that ran, so that the first new interval is one new cycle
            # time.
            due_ns = by_station[index] - old.cycle_ns + new.cycle_ns
            by_station[index] = (
                due_ns + max(0, -(-(now_ns - due_ns) // new.cycle_ns)) * new.cycle_ns
            )
            self._due = [
                (due_ns, self._stations[number].cycle_ns, number)
                for number, due_ns in by_station.items()
            ]
            heapify(self._due)

    def stop(self) -> None:
        """Bring all stations out of Op."""
        for station in self._stations:
            station.stop()

    def next_timeout(self) -> int:
        """Return when the next station or bus is due, on the clock that gives ``now_ns``."""
        due_ns = self._due[0][0]
        for bus in self._buses:
            bus_ns = bus.next_timeout()
            if bus_ns is not None and bus_ns < due_ns:
                due_ns = bus_ns
        return due_ns

    def handle_timeout(self, now_ns: int) -> None:
        """Run the station that is due first, else the bus; early calls are harmless.

        One a call, so that the caller reads the clock again before the next.  A station runs
        the timers of its own buses in its cycle, so a bus is late for no longer than that.
        """
        due_ns, cycle_ns, index = self._due[0]
        if due_ns > now_ns:
            self._handle_bus(now_ns)
            return
        station = self._stations[index]
        if due_ns != self._moment_ns:
            self._moment_ns, self._begun_ns = due_ns, now_ns
            station.cycle(due_ns, now_ns)
        else:
            behind_ns = _shift_place(station.image.words, now_ns - self._begun_ns)
            station.cycle(due_ns, now_ns, behind_ns)
        following_ns = due_ns + station.step_ns
        # Missed cycles are counted and not run late: a burst of them would delay all stations.
        if following_ns < now_ns:
            missed = -(-(now_ns - following_ns) // cycle_ns)
            station.image.words[StationWord.OVERRUNS] += missed
            following_ns += missed * cycle_ns
        heapreplace(self._due, (following_ns, cycle_ns, index))
        self.is_within_group = self._due[0][0] == self._moment_ns

    def receive(self, now_ns: int) -> None:
        """Receive frames between cycles: of channels drained on arrival, and of buses."""
        for channel in self._arrivals:
            channel.drain(now_ns)
        for bus in self._buses:
            bus.receive(now_ns)

    def _handle_bus(self, now_ns: int) -> None:
        """Run the timers of the bus that is due first."""
        first, first_ns = None, now_ns + 1
        for bus in self._buses:
            bus_ns = bus.next_timeout()
            if bus_ns is not None and bus_ns < first_ns:
                first, first_ns = bus, bus_ns
        if first is not None:
            first.handle_timeout(now_ns)


def _shift_place(words: memoryview, behind_ns: int) -> int:
    """Move a station's place in its group towards *behind_ns* and return it."""
    place_ns: int = words[_BEHIND_NS]
    later_ns = behind_ns - place_ns
    if not place_ns:
        place_ns = behind_ns
    elif later_ns > 0:
        place_ns += min(later_ns, _LATER_NS)
    else:  # far before its place, which was that of a slow start, it moves in larger steps
        place_ns -= min(-later_ns, max(_EARLIER_NS, -later_ns >> 4))
    words[_BEHIND_NS] = place_ns
    return place_ns
