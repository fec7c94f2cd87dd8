from __future__ import annotations

from eap.ams.loop_detector import MAX_PASSED, Passed


def test_only_the_latest_packets_are_known() -> None:
    passed = Passed()
    for number in range(MAX_PASSED + 1):
        passed.add(number, b"addresses")
    assert (0, b"addresses") not in passed
    assert (1, b"addresses") in passed
    assert (1, b"others") not in passed
