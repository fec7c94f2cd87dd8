from __future__ import annotations

import math

from eap.web.topics import MAX_POINTS, VariableHistory


def test_peak_of_one_sample_is_kept():
    history = VariableHistory(2400)  # intervals of 2 s
    for number in range(200):
        history.add(number * 0.1, 99.0 if number == 77 else 1.0)
    times, values = history.points()
    assert max(value for value in values if value is not None) == 99
    assert abs(times[values.index(99.0)] - 7.7) < 1e-9
    assert times == sorted(times)
    assert len(times) <= 2 * 10 + 2


def test_memory_and_window_are_bounded():
    history = VariableHistory(120)
    for number in range(20_000):
        history.add(number * 0.1, number % 7)
    times, values = history.points()
    assert len(times) == len(values) <= 2 * MAX_POINTS + 2
    assert times[-1] - times[0] <= 120
    assert len(history._times) < 2 * MAX_POINTS + 300


def test_points_since_a_time():
    history = VariableHistory(600)
    for number in range(100):
        history.add(float(number), number)
    assert history.points(95.0) == ([95.0, 96.0, 97.0, 98.0, 99.0], [95, 96, 97, 98, 99])
    assert VariableHistory(600).points() == ([], [])


def test_gap_is_none():
    history = VariableHistory(600)
    for time_s, value in ((1.0, 1), (2.0, None), (3.0, "text"), (4.0, math.nan), (5.0, True)):
        history.add(time_s, value)
    assert history.points() == ([1.0, 2.0, 3.0, 4.0, 5.0], [1, None, None, None, 1])


def test_value_beside_a_gap_in_one_interval_is_kept():
    history = VariableHistory(12_000)  # intervals of 10 s
    history.add(0.0, None)
    history.add(1.0, 5)
    history.add(2.0, 4)
    assert history.points() == ([1.0, 2.0], [5, 4])
    history.add(3.0, None)
    assert history.points() == ([1.0, 2.0], [5, 4])


def test_clock_that_is_set_back_ends_no_trend():
    history = VariableHistory(600)
    history.add(1000.0, 1)
    history.add(10.0, 2)
    history.add(11.0, 3)
    assert history.points()[1][-2:] == [2, 3]
