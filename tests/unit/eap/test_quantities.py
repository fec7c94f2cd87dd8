from __future__ import annotations

import pytest

from eap import quantities


@pytest.mark.parametrize(
    ("us", "text"),
    [
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
def test_duration(us: int, text: str) -> None:
    assert quantities.duration(us) == text


def test_quality_counts_in_100_us_and_saturates() -> None:
    assert quantities.quality(None) == ""
    assert quantities.quality(3) == "300 µs"
    assert quantities.quality(0xFFFE) == "6.6 s"
    assert quantities.quality(0xFFFF) == "> 6.5 s"


def test_numbers_agree_with_their_words() -> None:
    assert (quantities.times(1), quantities.times(2)) == ("once", "2 times")
    assert (quantities.count(1, "PD"), quantities.count(0, "PD")) == ("1 PD", "0 PDs")
