"""Statistics of arrivals: rhythm, jitter, step, order of the counter's bytes, guessed trigger."""

from __future__ import annotations

import pytest

from eap.pd.rhythm import CycleOrder, CycleWatch, Measured, Rhythm, swap
from eap.pd.words import Reason

MS = 1_000_000


def measured(
    times: list[int], cycles: list[int], changes: list[bool] | None = None, *, swapped: bool = False
) -> Measured:
    rhythm, watch = Rhythm(), CycleWatch()
    for number, (at_ns, cycle) in enumerate(zip(times, cycles, strict=True)):
        counter = swap(cycle & 0xFFFF) if swapped else cycle & 0xFFFF
        watch.enter(counter)
        rhythm.enter(at_ns, counter, is_changed=True if changes is None else changes[number])
    return rhythm.measure(watch.order)


def test_cyclic_pd_has_period_step_and_sender_cycle():
    times = [n * 20 * MS + (n % 2) * 60_000 for n in range(100)]
    found = measured(times, [7 + 2 * n for n in range(100)])
    assert found.trigger is Reason.CYCLE
    assert (found.period_us, found.step, found.sender_cycle_us) == (20_000, 2, 10_000)
    assert found.rate_hz == pytest.approx(50, rel=0.001)
    assert (found.jitter_us, found.jitter_max_us) == (120, 120)  # against the median of 20.06 ms
    assert found.missed == 0


def test_missing_frames_are_missed_and_no_jitter():
    kept = [n for n in range(100) if n not in {10, 11, 50}]
    found = measured([n * 10 * MS for n in kept], [65_500 + n for n in kept])
    assert (found.trigger, found.missed) == (Reason.CYCLE, 3)
    assert (found.period_us, found.jitter_max_us) == (10_000, 0)


def test_statistics_are_those_of_the_latest_arrivals():
    times = [n * 10 * MS for n in range(1000)]
    times += [times[-1] + n * 20 * MS for n in range(1, 600)]
    cycles = list(range(1000)) + [999 + 2 * n for n in range(1, 600)]
    found = measured(times, cycles)
    assert (found.period_us, found.step) == (20_000, 2)


@pytest.mark.parametrize(
    ("cycles", "order"),
    [
        (range(300), CycleOrder.LITTLE),
        (range(250, 550), CycleOrder.LITTLE),
        ([swap(n) for n in range(300)], CycleOrder.SWAPPED),
        ([swap(n & 0xFFFF) for n in range(65_400, 65_700)], CycleOrder.SWAPPED),
        ([7] * 20, CycleOrder.CONSTANT),
        ([1, 2], CycleOrder.UNKNOWN),
        ([], CycleOrder.UNKNOWN),
    ],
)
def test_order_of_the_counter_follows_from_its_steps(cycles, order):
    watch = CycleWatch()
    for cycle in cycles:
        watch.enter(cycle)
    assert watch.order is order


def test_swapped_counter_is_measured_in_its_own_order():
    found = measured([n * 10 * MS for n in range(300)], list(range(300)), swapped=True)
    assert (found.trigger, found.step, found.missed) == (Reason.CYCLE, 1, 0)


def test_constant_counter_leaves_the_clock():
    found = measured([n * 10 * MS + n % 2 * 100_000 for n in range(50)], [0] * 50)
    assert (found.trigger, found.period_us, found.step) == (Reason.CYCLE, 10_000, 0) or (
        found.trigger is Reason.CYCLE and found.period_us in {9_900, 10_100}
    )
    assert found.sender_cycle_us == 0


IRREGULAR = [0, 30, 50, 130, 140, 200, 390, 420, 500, 620, 640]


def test_irregular_pd_that_changes_each_time_is_sent_on_change():
    found = measured([n * MS for n in IRREGULAR], [n // 10 for n in IRREGULAR])
    assert (found.trigger, found.period_us, found.jitter_us) == (Reason.CHANGE, 0, None)
    assert found.sender_cycle_us == 10_000


def test_unchanged_data_after_a_constant_time_is_sent_again():
    times = [0, 30, 130, 230, 250, 350, 370, 470, 480, 580]
    changes = [True, True, False, False, True, False, True, False, True, False]
    found = measured([n * MS for n in times], [n // 10 for n in times], changes)
    assert (found.trigger, found.timeout_ms) == (Reason.CHANGE_TIMEOUT, 100)


def test_irregular_pd_with_the_same_data_is_an_event():
    found = measured(
        [n * MS for n in IRREGULAR], [n // 10 for n in IRREGULAR], [n == 0 for n in range(11)]
    )
    assert found.trigger is Reason.EVENT


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_few_arrivals_have_no_trigger(count):
    found = measured([n * MS for n in range(count)], list(range(count)))
    assert found.trigger is None
    assert found.rate_hz == (None if count < 2 else pytest.approx(1000))


def test_arrivals_at_one_moment_or_back_in_time_are_no_error():
    found = measured([5 * MS] * 10, list(range(10)))
    assert (found.rate_hz, found.period_us) == (None, 0)
    measured([MS * n for n in range(20, 0, -1)], list(range(20)))
