"""Starts of child processes, judged by their progress, on a clock of the test."""

from __future__ import annotations

from eap.supervisor.progress import (
    FIRST_LIMIT_NS,
    LONGEST_LIMIT_NS,
    StartEvent,
    StartWatch,
)

SECOND_NS = 1_000_000_000


def events_until(watch: StartWatch, from_ns: int, until_ns: int) -> list[tuple[int, StartEvent]]:
    """Return what the passing of time brings, with the second at which it does."""
    found = []
    now_ns = from_ns
    while (due_ns := watch.next_timeout()) is not None and due_ns <= until_ns:
        now_ns = max(now_ns, due_ns)
        assert watch.handle_timeout(due_ns - 1) is None
        event = watch.handle_timeout(now_ns)
        assert event is not None
        found.append((now_ns // SECOND_NS, event))
    return found


def begun() -> StartWatch:
    watch = StartWatch()
    watch.begin(0)
    return watch


def test_start_without_progress_is_stuck_after_the_first_limit():
    watch = begun()
    assert events_until(watch, 0, 10**12) == [(10, StartEvent.SLOW), (20, StartEvent.STUCK)]
    assert watch.is_stuck
    assert watch.step == "starting Python"


def test_start_that_goes_on_is_never_stuck():
    watch, now_ns = begun(), 0
    events = []
    for number in range(100):
        now_ns += FIRST_LIMIT_NS - SECOND_NS
        events += events_until(watch, now_ns, now_ns)
        watch.advance(f"building station {number}", now_ns)
    assert {event for _, event in events} == {StartEvent.SLOW}
    assert len(events) < 10  # notes come ever later
    watch.succeed()
    assert watch.next_timeout() is None


def test_start_that_repeats_a_step_makes_no_progress():
    watch = begun()
    watch.advance("waiting", 15 * SECOND_NS)
    watch.advance("waiting", 30 * SECOND_NS)
    assert (35, StartEvent.STUCK) in events_until(watch, 30 * SECOND_NS, 10**12)


def test_limit_doubles_with_each_start_that_is_stuck_until_one_succeeds():
    watch, limits = begun(), []
    for _ in range(8):
        watch.begin(0)
        limits.append(watch.limit_ns)
        assert events_until(watch, 0, 10**13)[-1] == (limits[-1] // SECOND_NS, StartEvent.STUCK)
        watch.end()
    assert limits[:3] == [FIRST_LIMIT_NS, 2 * FIRST_LIMIT_NS, 4 * FIRST_LIMIT_NS]
    assert limits[-1] == LONGEST_LIMIT_NS
    watch.begin(0)
    watch.succeed()
    assert watch.has_run
    assert watch.limit_ns == FIRST_LIMIT_NS


def test_start_that_waits_for_another_process_has_no_limit_until_that_runs():
    watch = begun()
    watch.advance("waiting for the engine", 0, waits_for="engine")
    assert {event for _, event in events_until(watch, 0, 10**13)} == {StartEvent.SLOW}
    watch.release("services", 10**13)
    watch.release("engine", 10**13)
    assert events_until(watch, 10**13, 10**14)[-1] == (10_020, StartEvent.STUCK)


def test_process_that_ended_is_not_watched():
    watch = begun()
    watch.end()
    assert watch.next_timeout() is None
    assert watch.handle_timeout(10**15) is None
    assert (watch.step, watch.took_ns(5)) == ("", 0)
