"""Figures of plants: the demo, and the limits of one engine."""

from __future__ import annotations

from typing import Any

import msgspec

from tools.bench import demo, limits
from tools.bench.appliance import Observation
from tools.bench.figures import Decision

SEEN = Observation(
    seconds=1.0,
    cpu={"supervisor": 0.0, "engine": 0.04, "services": 0.01, "a/bus0": 0.01, "b/bus0": 0.03},
    kernel={"supervisor": 0.0, "engine": 0.01, "services": 0.0, "a/bus0": 0.0, "b/bus0": 0.01},
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
    ready, engine, segment, own, everything = demo.figures_of([1.0, 2.0, 1.2], SEEN)
    assert (ready.value, engine.value, segment.value) == (1.2, 4.0, 3.0)
    assert segment.decision is Decision.MISSED
    assert (own.value, everything.value) == (90.0, 150.0)
    assert engine.limit == "the kernel's part of it: 1.0 %"


def test_shortest_cycle_is_the_last_good_one() -> None:
    figure = limits.cycle_figure([((14, 500), SEEN), ((14, 400), seen(overruns=50))])
    assert (figure.value, figure.decision) == (500, Decision.MISSED)
    assert figure.limit == "at 400 µs 5.0% of the cycles left out, 0 frames lost"


def test_most_stations_are_the_last_good_ones() -> None:
    figure = limits.stations_figure([((220, 10_000), SEEN), ((300, 10_000), SEEN)])
    assert (figure.value, figure.decision) == (301, Decision.OK)
    assert figure.measured == "301 stations (engine 4% of a core)"


def test_plant_that_fails_at_once_has_no_limit() -> None:
    for figure in (limits.cycle_figure, limits.stations_figure):
        assert figure([((14, 500), seen(lost=1))]).measured == "none of those tried"
