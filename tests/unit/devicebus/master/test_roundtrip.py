"""The time-out of a frame by the round trips before it."""

from __future__ import annotations

import pytest

from devicebus.master.roundtrip import BACKOFF_LIMIT_NS, CEILING_NS, FLOOR_NS, RoundTrip

MS = 1_000_000


def test_round_trip_not_measured_yet_is_waited_for_patiently():
    trip = RoundTrip()
    assert (trip.timeout_ns, trip.smoothed_ns) == (BACKOFF_LIMIT_NS, 0)
    assert RoundTrip(ceiling_ns=3 * MS).timeout_ns == 3 * MS


def test_round_trip_follows_rfc_6298():
    trip = RoundTrip()
    trip.measure(8 * MS)
    assert (trip.smoothed_ns, trip.timeout_ns) == (8 * MS, 24 * MS)
    trip.measure(16 * MS)
    assert (trip.smoothed_ns, trip.timeout_ns) == (9 * MS, 9 * MS + 4 * 5 * MS)


@pytest.mark.parametrize(
    ("trip_ns", "timeout_ns"), [(20_000, FLOOR_NS), (5_000 * MS, CEILING_NS), (0, FLOOR_NS)]
)
def test_round_trip_has_a_floor_and_a_ceiling(trip_ns, timeout_ns):
    trip = RoundTrip()
    for _ in range(50):
        trip.measure(trip_ns)
    assert trip.timeout_ns == timeout_ns


def test_round_trip_backs_off_up_to_its_patience():
    trip = RoundTrip()
    trip.measure(MS // 2)
    waits = [trip.timeout_of(number, 9) // MS for number in range(1, 10)]
    assert waits == [2, 4, 8, 16, 32, 64, 100, 100, 100]
    assert [trip.timeout_of(number, 3) // MS for number in (1, 2, 3)] == [2, 4, 100]
    assert trip.timeout_of(1, 1) == FLOOR_NS


def test_round_trip_longer_than_patience_is_waited_for_each_time():
    trip = RoundTrip()
    trip.measure(100 * MS)
    assert [trip.timeout_of(number, 3) // MS for number in (1, 2, 3)] == [300] * 3
