"""Figures of plants: the demo, and the limits of one engine."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from tools.bench import demo, limits
from tools.bench.appliance import Observation
from tools.bench.figures import Decision

SEEN = Observation(
    seconds=1.0,
    cpu={"supervisor": 0.0, "engine": 0.04, "services": 0.01, "a/bus0": 0.01, "b/bus0": 0.03},
    rss=dict.fromkeys(("supervisor", "engine", "services", "a/bus0", "b/bus0"), 30 << 20),
    lost=0,
    received=1,
    overruns=0,
    cycles=1000,
    lateness_us={},
)


def seen(**changes: Any) -> Observation:
    return msgspec.structs.replace(SEEN, **changes)


def test_demo_names_the_dearest_segment_and_the_memory_of_its_own_processes() -> None:
    ready, engine, segment, own, everything = demo.figures_of([1.0, 2.0, 1.2], 0.9, SEEN, 0.01)
    assert (ready.value, engine.value, segment.value) == (1.2, 4.0, 3.0)
    assert ready.limit == "CPU time of its imports: 0.9 s"
    assert segment.decision is Decision.MISSED
    assert (own.value, everything.value) == (90.0, 150.0)
    assert engine.limit == "a loop that only wakes: 1.0 %"
    assert (
        demo.figures_of([1.0], 0.9, SEEN, None)[1].limit == "a loop that only wakes, not measured"
    )


def test_shortest_cycle_is_the_last_good_one() -> None:
    figure = limits.cycle_figure([(500, SEEN), (400, seen(overruns=50)), (300, None)])
    assert (figure.value, figure.decision) == (500, Decision.MISSED)
    assert figure.limit == "at 400 µs 5.0% of the cycles left out, 0 frames lost"


def test_most_stations_are_the_last_good_ones() -> None:
    figure = limits.stations_figure([(220, SEEN), (301, SEEN), (350, None)])
    assert (figure.value, figure.decision) == (301, Decision.OK)
    assert figure.measured == "301 stations (engine 4% of a core)"
    assert figure.limit == "at 350 stations the plant does not get ready"
    assert limits.stations_figure([(500, SEEN)]).limit == "none found"


def test_plant_that_fails_at_once_has_no_limit() -> None:
    for figure in (limits.cycle_figure, limits.stations_figure):
        assert figure([(500, seen(lost=1))]).measured == "none of those tried"


@pytest.mark.parametrize(
    ("good_up_to", "looked_at"),
    [(6, [4, 5, 6, 7]), (2, [2, 3, 4]), (9, [4, 5, 6, 7, 8]), (0, [1, 2, 3, 4])],
)
def test_search_goes_from_its_target_to_the_limit(good_up_to: int, looked_at: list[int]) -> None:
    calls: list[int] = []

    def look(case: int) -> Observation:
        calls.append(case)
        return seen(lost=int(case > good_up_to))

    found = limits.search(range(1, 9), 4, look)
    assert [case for case, _ in found] == looked_at
    bad = [case for case in looked_at if case > good_up_to]
    assert sorted(calls) == sorted(looked_at + bad), "a case that fails is observed twice"


def test_plant_that_does_not_get_ready_is_not_started_again() -> None:
    calls: list[int] = []

    def look(case: int) -> Observation | None:
        calls.append(case)
        return SEEN if case < 3 else None

    assert limits.search(range(1, 9), 4, look) == [(2, SEEN), (3, None), (4, None)]
    assert calls == [4, 3, 2]
