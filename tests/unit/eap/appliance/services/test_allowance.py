from __future__ import annotations

from eap.appliance.services.allowance import Allowance


def takes(allowance: Allowance, now_s: float) -> int:
    count = 0
    while allowance.take(now_s):
        count += 1
    return count


def test_a_burst_and_what_comes_back() -> None:
    allowance = Allowance(10, 2.0, 100.0)
    assert takes(allowance, 100.0) == 10
    assert takes(allowance, 100.4) == 0
    assert takes(allowance, 102.0) == 4
    assert takes(allowance, 90.0) == 0, "a clock that goes back gives nothing"
    assert takes(allowance, 1000.0) == 10
