"""Phases of stations that have none of their own: groups of stations that begin together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from eap.config.index import Index

STATIONS_PER_GROUP = 16
"""Stations of one cycle time that begin together, one after the other, unless the plant says more.

Each group wakes the engine, and finds cold what other programs have used the caches for: the
fifteen stations of the solar line took 14 % of a core in eight groups, 10 in four, 9 in two and 8
in one.  In long groups the deviations of all stations before one add up to its lateness.
"""
MIN_DISTANCE_US = 250
"""Shortest distance between the begins of two groups, so that one ends before the next."""


def derive_phases(index: Index) -> Sequence[int]:
    """Return the phase of each station in microseconds, in the order of the plant file."""
    stations = index.plant.stations
    staggered = Counter(index.cycle_us(each) for each in stations if each.phase_us is None)
    placed: Counter[int] = Counter()
    phases: list[int] = []
    for station in stations:
        if station.phase_us is not None:
            phases.append(station.phase_us)
            continue
        cycle_us = index.cycle_us(station)
        groups = _groups(staggered[cycle_us], cycle_us, index.plant.realtime.groups)
        # By turns: neighbours in the file, which often send to each other, are in different groups.
        phases.append(placed[cycle_us] % groups * (cycle_us // groups))
        placed[cycle_us] += 1
    return phases


def _groups(stations: int, cycle_us: int, wanted: int | None) -> int:
    usual = -(-stations // STATIONS_PER_GROUP)
    return max(1, min(stations, wanted or usual, cycle_us // MIN_DISTANCE_US))
