"""Figures of plant changes."""

from __future__ import annotations

import pytest

from tools.bench.change import Change, lateness_figures, swap_figures
from tools.bench.change_roles import station
from tools.bench.figures import Decision


def test_swaps_are_held_against_the_target():
    changes = [Change(2_000_000, swap, 30_000, 10_000) for swap in (100_000, 200_000, 900_000)]
    swap, build = swap_figures(1000, changes, 0.3)
    assert (swap.name, swap.value, swap.decision) == ("1,000 PDs each way: swap", 0.2, Decision.OK)
    assert "max 0.90 ms; the cycle after it 30 us, others 10 us" in swap.measured
    assert build.measured == "2.0 ms"
    assert swap_figures(1000, changes, 0.1)[0].decision is Decision.MISSED


def test_lateness_is_split_by_cause():
    found = {"changes": 3, "lost": 0, "refused": "", "quiet_ns": [10_000], "disturbed_ns": [90_000]}
    quiet, changing = lateness_figures(found)
    assert quiet.measured == "p50 10 us, p99 10 us, max 10 us"
    assert changing.measured == "p50 90 us, p99 90 us, max 90 us (3 changes, nothing lost)"


@pytest.mark.parametrize(("field", "value"), [("changes", 0), ("lost", 1), ("refused", "no room")])
def test_a_measurement_that_went_wrong_is_none(field, value):
    found = {"changes": 3, "lost": 0, "refused": "", "quiet_ns": [1], "disturbed_ns": [1]}
    with pytest.raises(RuntimeError, match=str(value)):
        lateness_figures(found | {field: value})


def test_station_receives_its_own_pd():
    spec = station(25, 1)
    assert [len(frame.pds) for frame in spec.frames] == [1, 10, 10, 5]
    sent = {pd.pd_id for frame in spec.frames for pd in frame.pds}
    assert {pd.pd_id for pd in spec.subscriptions} == sent - {60_000}
