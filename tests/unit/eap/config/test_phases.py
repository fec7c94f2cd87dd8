from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from eap.config.index import Index
from eap.config.phases import MIN_DISTANCE_US, STATIONS_PER_GROUP, derive_phases
from eap.config.plant_sections import PlantFile
from eap.config.structs import RealtimeSection, StationSection
from eap.ids import NetId


def phases(cycles, *, groups=None, own=None):
    """Return the phases of stations with these cycle times; *own* are phases by position."""
    stations = tuple(
        StationSection(
            name=f"s{number}",
            net_id=NetId.parse(f"127.0.9.{number % 250 + 1}.1.1"),
            ports=(),
            cycle_us=cycle_us,
            phase_us=(own or {}).get(number),
        )
        for number, cycle_us in enumerate(cycles)
    )
    plant = PlantFile(plant="p", stations=stations, realtime=RealtimeSection(groups=groups))
    return list(derive_phases(Index(plant, {})))


def test_a_few_stations_of_one_cycle_time_begin_together():
    assert phases([10_000] * STATIONS_PER_GROUP) == [0] * STATIONS_PER_GROUP


def test_more_stations_begin_in_more_groups_by_turns():
    assert phases([10_000] * (STATIONS_PER_GROUP + 1))[:3] == [0, 5000, 0]
    assert Counter(phases([10_000] * 300)).most_common(1)[0][1] <= STATIONS_PER_GROUP


def test_stations_begin_in_the_groups_that_the_plant_names():
    assert phases([10_000] * 4, groups=2) == [0, 5000, 0, 5000]
    assert phases([10_000] * 3, groups=64) == [0, 3333, 6666]


def test_groups_of_short_cycles_are_not_nearer_than_their_distance():
    assert phases([400] * 4, groups=4) == [0] * 4
    assert phases([500] * 4, groups=4) == [0, 250, 0, 250]


def test_stations_of_each_cycle_time_take_their_own_turns():
    assert phases([10_000, 1000, 10_000, 1000], groups=2) == [0, 0, 5000, 500]


def test_a_station_with_a_phase_of_its_own_takes_no_turn():
    assert phases([10_000] * 3, groups=2, own={0: 7, 1: None}) == [7, 0, 5000]


@given(
    st.lists(st.sampled_from([100, 250, 1000, 9_999, 60_000_000]), min_size=1, max_size=40),
    st.none() | st.integers(1, 64),
)
def test_groups_are_even_and_lie_within_their_cycle(cycles, groups):
    found = phases(cycles, groups=groups)
    for cycle_us in set(cycles):
        sizes = Counter(p for p, each in zip(found, cycles, strict=True) if each == cycle_us)
        moments = sorted(sizes)
        assert max(sizes.values()) - min(sizes.values()) <= 1
        assert len(sizes) <= (groups or -(-len(cycles) // STATIONS_PER_GROUP))
        ends = [*moments[1:], cycle_us]
        distances = [end - begin for begin, end in zip(moments, ends, strict=True)]
        assert min(distances) >= min(MIN_DISTANCE_US, cycle_us)
