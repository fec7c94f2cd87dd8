from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.pd.monitor import DEFAULT_POLICY, Evidence, PresenceTracker, SubscriberPresence

SECOND = 1_000_000_000
SEEN, MISSED, ABSENT = Evidence.SEEN, Evidence.MISSED, Evidence.ABSENT
PENDING, BLIND = Evidence.PENDING, Evidence.BLIND
UNKNOWN, PRESENT, MISSING = (
    SubscriberPresence.UNKNOWN,
    SubscriberPresence.PRESENT,
    SubscriberPresence.MISSING,
)


def run(*rounds: Evidence, judge: PresenceTracker | None = None) -> list[SubscriberPresence]:
    """Return what each of *rounds*, one a second, made of the presence."""
    judge = judge or PresenceTracker(SECOND, 0)
    found = []
    for number, evidence in enumerate(rounds, 1):
        judge.begin_round()
        found.append(judge.take(evidence, number * SECOND))
    return found


def test_first_answer_is_believed() -> None:
    assert run(SEEN) == [PRESENT]


def test_missing_after_three_rounds_without_an_answer() -> None:
    assert run(SEEN, MISSED, MISSED, MISSED) == [PRESENT, PRESENT, PRESENT, MISSING]
    assert run(MISSED, MISSED, MISSED) == [UNKNOWN, UNKNOWN, MISSING]


def test_an_answer_in_between_starts_the_count_again() -> None:
    assert run(SEEN, MISSED, MISSED, SEEN, MISSED, MISSED)[-1] is PRESENT


def test_what_is_certain_needs_no_second_round() -> None:
    assert run(SEEN, ABSENT) == [PRESENT, MISSING]
    assert run(ABSENT) == [MISSING]


def test_missing_is_present_again_after_two_answers() -> None:
    assert run(ABSENT, SEEN, SEEN) == [MISSING, MISSING, PRESENT]
    assert run(ABSENT, SEEN, MISSED, SEEN) == [MISSING] * 4


def test_a_round_counts_once_however_much_is_heard() -> None:
    judge = PresenceTracker(SECOND, 0)
    run(ABSENT, judge=judge)
    judge.begin_round()
    assert [judge.take(SEEN, 2 * SECOND) for _ in range(5)] == [MISSING] * 5
    judge.begin_round()
    assert judge.take(SEEN, 3 * SECOND) is PRESENT


def test_silence_after_an_answer_in_the_same_round_is_no_miss() -> None:
    judge = PresenceTracker(SECOND, 0)
    for number in range(5):
        judge.begin_round()
        judge.take(SEEN, number * SECOND)
        assert judge.take(MISSED, number * SECOND) is PRESENT
        assert not judge.in_doubt


def test_blind_rounds_end_in_unknown() -> None:
    assert run(SEEN, BLIND, BLIND, BLIND) == [PRESENT, PRESENT, PRESENT, UNKNOWN]
    assert run(ABSENT, BLIND, BLIND, BLIND)[-1] is UNKNOWN


def test_what_was_told_last_holds_for_a_while_only() -> None:
    judge = PresenceTracker(SECOND, 0)
    judge.take(SEEN, 0)
    assert judge.take(PENDING, DEFAULT_POLICY.trust_ns) is PRESENT
    assert judge.take(PENDING, DEFAULT_POLICY.trust_ns + 1) is UNKNOWN


def test_long_intervals_are_trusted_for_longer() -> None:
    judge = PresenceTracker(60 * SECOND, 0)
    judge.take(SEEN, 0)
    assert judge.take(PENDING, 180 * SECOND) is PRESENT
    assert judge.take(PENDING, 180 * SECOND + 1) is UNKNOWN


@pytest.mark.parametrize(
    ("rounds", "doubt"),
    [((SEEN,), False), ((SEEN, MISSED), True), ((ABSENT,), False), ((ABSENT, SEEN), True)],
)
def test_doubt_is_one_round_that_disagrees(rounds: tuple[Evidence, ...], doubt: bool) -> None:
    judge = PresenceTracker(SECOND, 0)
    run(*rounds, judge=judge)
    assert judge.in_doubt is doubt


@given(st.lists(st.sampled_from([MISSED, ABSENT, PENDING, BLIND])))
def test_never_present_without_having_been_seen(rounds: list[Evidence]) -> None:
    assert PRESENT not in run(*rounds)
