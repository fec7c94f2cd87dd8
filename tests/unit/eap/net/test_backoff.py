from __future__ import annotations

from eap.net.backoff import Backoff


def test_waits_grow_up_to_a_limit_and_begin_anew() -> None:
    backoff = Backoff(0.5, 3)
    for _ in range(2):
        for longest in (0.5, 1, 2, 3, 3):
            assert longest / 2 <= backoff.next_s() <= longest
        backoff.reset()


def test_waits_differ() -> None:
    assert len({Backoff(1, 2).next_s() for _ in range(10)}) > 5
