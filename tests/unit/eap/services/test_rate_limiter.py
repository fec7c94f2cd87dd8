from __future__ import annotations

from eap.services.rate_limits import Rate, RateLimiter, SourceRateLimiter, SourceRates


def takes(allowance: RateLimiter, now_s: float) -> int:
    count = 0
    while allowance.take(now_s):
        count += 1
    return count


def test_rate_limiter_allows_a_burst_and_refills() -> None:
    allowance = RateLimiter(10, 2.0, 100.0)
    assert takes(allowance, 100.0) == 10
    assert takes(allowance, 100.4) == 0
    assert takes(allowance, 102.0) == 4
    assert takes(allowance, 90.0) == 0, "a clock that goes back gives nothing"
    assert takes(allowance, 1000.0) == 10


def test_source_rate_limiter_forgets_the_source_silent_for_longest() -> None:
    one, many = Rate(1, 0.0), Rate(100, 0.0)
    limiter = SourceRateLimiter(SourceRates(one, many, many, one), 2, 0.0)
    assert [limiter.take(each, 0.0) for each in "aba"] == [True, True, False]
    assert limiter.take("c", 0.0), "in the place of b"
    assert [limiter.take(each, 0.0) for each in "ac"] == [False, False]
    assert limiter.take("b", 0.0), "which is new again"
    assert [limiter.take_local(0.0) for _ in range(2)] == [True, False]
