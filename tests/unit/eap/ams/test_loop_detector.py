from __future__ import annotations

from eap.ams.inflight import MAX_PASSED, LoopDetector


def test_only_the_latest_packets_are_known() -> None:
    loop_detector = LoopDetector()
    for number in range(MAX_PASSED + 1):
        loop_detector.add(number, b"addresses")
    assert (0, b"addresses") not in loop_detector
    assert (1, b"addresses") in loop_detector
    assert (1, b"others") not in loop_detector
