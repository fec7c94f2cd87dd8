from __future__ import annotations

import pytest

from eap import quantities


@pytest.mark.parametrize(
    ("us", "text"),
    [
        (None, ""),
        (0, "0"),
        (999, "999 µs"),
        (1000, "1.0 ms"),
        (42_600, "42.6 ms"),
        (1_000_000, "1.0 s"),
        (119_900_000, "119.9 s"),
        (120_000_000, "2 min"),
        (7_200_000_000, "2 h"),
    ],
)
def test_duration_has_a_fitting_unit(us: int | None, text: str) -> None:
    assert quantities.duration(us) == text


def test_quality_counts_in_100_us_and_saturates() -> None:
    assert quantities.quality(None) == ""
    assert quantities.quality(3) == "300 µs"
    assert quantities.quality(0xFFFE) == "6.6 s"
    assert quantities.quality(0xFFFF) == "> 6.5 s"


def test_numbers_agree_with_their_words() -> None:
    assert (quantities.times(1), quantities.times(2)) == ("once", "2 times")
    assert (quantities.count(1, "PD"), quantities.count(0, "PD")) == ("1 PD", "0 PDs")


def test_age_of_a_time_to_come_is_none() -> None:
    assert quantities.age(10.0, 11.5) == "1.5 s"
    assert quantities.age(11.5, 10.0) == "0"


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (1, "1 byte"),
        (999, "999 bytes"),
        (1000, "1.0 kB"),
        (2_500_000, "2.5 MB"),
        (4 * 10**9, "4.0 GB"),
    ],
)
def test_size_has_a_fitting_unit(number: int, text: str) -> None:
    assert quantities.size(number) == text
