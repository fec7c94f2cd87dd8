from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ids import MacAddr
from eap.pd.monitor import (
    DEFAULT_MONITOR_POLICY,
    DEFAULT_POLICY,
    MonitorTarget,
    PresenceChanged,
    PresenceTracker,
    ProbeResult,
    SubscriberMonitor,
    SubscriberPresence,
)

MS = 1_000_000
SECOND = 1000 * MS
THEIRS = MacAddr.parse("02:00:00:00:00:02")
OTHER = MacAddr.parse("02:00:00:00:00:03")
UNKNOWN, PRESENT, MISSING = (
    SubscriberPresence.UNKNOWN,
    SubscriberPresence.PRESENT,
    SubscriberPresence.MISSING,
)


class Run:
    """A monitor and the time; *answer* says what comes of a question, None for silence."""

    def __init__(self, *targets: MonitorTarget, start_ns: int = 0) -> None:
        self.monitor = SubscriberMonitor(start_ns)
        self.now_ns = start_ns
        self.asked: list[tuple[int, str]] = []
        for target in targets:
            self.monitor.add(target, start_ns)

    def until(self, end_ns: int, answer: Callable[[str], MacAddr | None] = lambda _: None) -> None:
        while (due_ns := self.monitor.next_timeout()) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            for name in self.monitor.probes_to_send(self.now_ns):
                self.asked.append((self.now_ns, name))
                if mac := answer(name):
                    self.monitor.receive_reply(name, mac, self.now_ns)
        self.now_ns = end_ns

    def presence(self, name: str = "a") -> SubscriberPresence:
        return self.monitor.presence(name)


def target(name: str = "a", interval_ms: int = 1000, mac: MacAddr | None = None) -> MonitorTarget:
    return MonitorTarget(name, interval_ms * MS, mac)


def test_monitor_probes_at_once_and_then_once_an_interval() -> None:
    run = Run(target(interval_ms=2000))
    run.until(6 * SECOND, lambda _: THEIRS)
    assert [at for at, _ in run.asked] == [0, 2 * SECOND, 4 * SECOND, 6 * SECOND]
    assert run.presence() is PRESENT


@pytest.mark.parametrize("interval_ms", [1, 100, 500, 501, 1000, 20_000])
def test_silence_is_missing_after_three_questions(interval_ms: int) -> None:
    run = Run(target(interval_ms=interval_ms))
    run.until(3600 * SECOND) if interval_ms >= 1000 else run.until(10 * SECOND)
    third = run.asked[2][0]
    assert run.presence() is MISSING
    assert len(run.asked) > 10
    early = Run(target(interval_ms=interval_ms))
    early.until(third)
    assert early.presence() is UNKNOWN


def test_monitor_probes_sooner_in_doubt() -> None:
    run = Run(target(interval_ms=60_000))
    run.until(59 * SECOND, lambda _: THEIRS)
    run.until(70 * SECOND)
    assert [at for at, _ in run.asked] == [0, 60 * SECOND, 61 * SECOND, 62 * SECOND]
    assert run.presence() is MISSING


def test_subscriber_that_comes_back_is_present() -> None:
    run = Run(target())
    run.until(10 * SECOND)
    run.until(12 * SECOND, lambda _: THEIRS)
    assert run.presence() is PRESENT
    events = []
    while event := run.monitor.next_event():
        events.append(event)
    assert events == [
        PresenceChanged("a", UNKNOWN, MISSING, ProbeResult.MISSED, None),
        PresenceChanged("a", MISSING, PRESENT, ProbeResult.SEEN, THEIRS),
    ]


def test_answer_from_where_the_frames_do_not_go_does_not_count() -> None:
    run = Run(target(mac=THEIRS))
    run.until(10 * SECOND, lambda _: OTHER)
    assert run.presence() is MISSING
    event = run.monitor.next_event()
    assert event is not None
    assert event.answered_by == OTHER
    run.until(20 * SECOND, lambda _: THEIRS)
    assert run.presence() is PRESENT


def test_late_answer_counts_all_the_same() -> None:
    run = Run(target())
    run.until(900 * MS)
    run.monitor.receive_reply("a", THEIRS, run.now_ns)
    assert run.presence() is PRESENT


def test_no_more_than_fifty_questions_a_second() -> None:
    run = Run(*(target(f"t{n}", 100) for n in range(200)))
    run.until(20 * SECOND, lambda _: THEIRS)
    times = [at for at, _ in run.asked]
    for at in times:
        assert (
            sum(at <= other < at + SECOND for other in times) <= DEFAULT_MONITOR_POLICY.probes_per_s
        )
    assert {name for _, name in run.asked} == {f"t{n}" for n in range(200)}  # nobody starves
    assert all(run.presence(f"t{n}") is PRESENT for n in range(200))


def test_a_host_that_checks_its_address_is_left_alone() -> None:
    run = Run(target())
    run.until(1500 * MS, lambda _: THEIRS)
    for at in (1600, 2600, 3600):
        run.until(at * MS)
        run.monitor.receive_claim("a", THEIRS, run.now_ns)
    run.until(60 * SECOND, lambda _: THEIRS)
    times = [at for at, _ in run.asked]
    assert times[:3] == [0, SECOND, 1600 * MS + DEFAULT_MONITOR_POLICY.claim_ns]
    assert run.presence() is PRESENT


def test_two_monitors_of_one_address_do_not_silence_each_other() -> None:
    one, two = (Run(target(), start_ns=at) for at in (0, 300 * MS))
    for now_ns in range(0, 120 * SECOND, 50 * MS):
        for run, mac, rival in ((one, THEIRS, two), (two, OTHER, one)):
            before = len(run.asked)
            run.until(now_ns, lambda _: MacAddr(b"\x02\0\0\0\0\x09"))
            for at, name in run.asked[before:]:
                rival.monitor.receive_claim(name, mac, at)
    for run in (one, two):
        assert run.presence() is PRESENT
        late = [at for at, _ in run.asked if at > 60 * SECOND]
        assert len(late) >= 50


def test_claims_of_many_hosts_take_bounded_memory() -> None:
    run = Run(target())
    for n in range(1000):
        run.monitor.receive_claim("a", MacAddr(b"\x02\0\0\0" + n.to_bytes(2)), n)
    run.until(30 * SECOND, lambda _: THEIRS)
    assert run.presence() is PRESENT


def test_monitor_accepts_result_without_probe() -> None:
    run = Run(target())
    assert run.monitor.probes_to_send(0) == ["a"]
    run.monitor.receive_result("a", ProbeResult.ABSENT, 0)
    assert run.presence() is MISSING
    assert run.monitor.probes_to_send(SECOND - 1) == []
    assert run.monitor.probes_to_send(SECOND) == ["a"]


def test_monitor_does_not_probe_removed_targets() -> None:
    run = Run(target(), target("b"))
    run.monitor.remove("a")
    run.monitor.remove("nobody")
    run.until(5 * SECOND)
    assert {name for _, name in run.asked} == {"b"}
    assert run.presence() is UNKNOWN
    run.monitor.receive_reply("a", THEIRS, run.now_ns)
    run.monitor.receive_claim("a", THEIRS, run.now_ns)
    run.monitor.receive_result("a", ProbeResult.SEEN, run.now_ns)
    assert run.monitor.next_event().name == "b"
    assert run.monitor.next_event() is None


def test_monitor_resets_target_of_same_name() -> None:
    run = Run(target())
    run.until(5 * SECOND, lambda _: THEIRS)
    run.monitor.add(target(mac=OTHER), run.now_ns)
    assert run.presence() is UNKNOWN
    run.until(20 * SECOND, lambda _: THEIRS)
    assert run.presence() is MISSING


def test_monitor_without_targets_has_no_timeout() -> None:
    assert SubscriberMonitor(0).next_timeout() is None


actions = st.lists(
    st.tuples(
        st.sampled_from(["wait", "reply", "other", "claim", "blind", "absent", "add", "remove"]),
        st.sampled_from(["a", "b"]),
        st.integers(0, 3000),
    ),
    max_size=40,
)


@given(actions)
def test_monitor_keeps_probing_after_any_results(
    steps: list[tuple[str, str, int]],
) -> None:
    run = Run(target("a", 700, THEIRS), target("b", 300))
    watched = {"a", "b"}
    for action, name, pause in steps:
        run.until(run.now_ns + pause * MS)
        monitor, now_ns = run.monitor, run.now_ns
        match action:
            case "reply":
                monitor.receive_reply(name, THEIRS, now_ns)
            case "other":
                monitor.receive_reply(name, OTHER, now_ns)
            case "claim":
                monitor.receive_claim(name, OTHER, now_ns)
            case "blind":
                monitor.receive_result(name, ProbeResult.BLIND, now_ns)
            case "absent":
                monitor.receive_result(name, ProbeResult.ABSENT, now_ns)
            case "add":
                monitor.add(target(name, 700), now_ns)
                watched.add(name)
            case "remove":
                monitor.remove(name)
                watched.discard(name)
    run.asked.clear()
    run.until(run.now_ns + 30 * SECOND, lambda _: THEIRS)
    assert {name for _, name in run.asked} == watched
    assert all(run.presence(name) is PRESENT for name in watched)


SEEN, MISSED, ABSENT = ProbeResult.SEEN, ProbeResult.MISSED, ProbeResult.ABSENT
PENDING, BLIND = ProbeResult.PENDING, ProbeResult.BLIND
UNKNOWN, PRESENT, MISSING = (
    SubscriberPresence.UNKNOWN,
    SubscriberPresence.PRESENT,
    SubscriberPresence.MISSING,
)


def run(*rounds: ProbeResult, tracker: PresenceTracker | None = None) -> list[SubscriberPresence]:
    """Return what each of *rounds*, one a second, made of the presence."""
    tracker = tracker or PresenceTracker(SECOND, 0)
    found = []
    for number, result in enumerate(rounds, 1):
        tracker.begin_round()
        found.append(tracker.enter(result, number * SECOND))
    return found


def test_first_answer_is_believed() -> None:
    assert run(SEEN) == [PRESENT]


def test_missing_after_three_rounds_without_an_answer() -> None:
    assert run(SEEN, MISSED, MISSED, MISSED) == [PRESENT, PRESENT, PRESENT, MISSING]
    assert run(MISSED, MISSED, MISSED) == [UNKNOWN, UNKNOWN, MISSING]


def test_an_answer_in_between_starts_the_count_again() -> None:
    assert run(SEEN, MISSED, MISSED, SEEN, MISSED, MISSED)[-1] is PRESENT


def test_presence_changes_at_once_on_proof() -> None:
    assert run(SEEN, ABSENT) == [PRESENT, MISSING]
    assert run(ABSENT) == [MISSING]


def test_missing_is_present_again_after_two_answers() -> None:
    assert run(ABSENT, SEEN, SEEN) == [MISSING, MISSING, PRESENT]
    assert run(ABSENT, SEEN, MISSED, SEEN) == [MISSING] * 4


def test_presence_round_counts_once_despite_many_results() -> None:
    tracker = PresenceTracker(SECOND, 0)
    run(ABSENT, tracker=tracker)
    tracker.begin_round()
    assert [tracker.enter(SEEN, 2 * SECOND) for _ in range(5)] == [MISSING] * 5
    tracker.begin_round()
    assert tracker.enter(SEEN, 3 * SECOND) is PRESENT


def test_silence_after_an_answer_in_the_same_round_is_no_miss() -> None:
    tracker = PresenceTracker(SECOND, 0)
    for number in range(5):
        tracker.begin_round()
        tracker.enter(SEEN, number * SECOND)
        assert tracker.enter(MISSED, number * SECOND) is PRESENT
        assert not tracker.in_doubt


def test_blind_rounds_end_in_unknown() -> None:
    assert run(SEEN, BLIND, BLIND, BLIND) == [PRESENT, PRESENT, PRESENT, UNKNOWN]
    assert run(ABSENT, BLIND, BLIND, BLIND)[-1] is UNKNOWN


def test_presence_becomes_unknown_after_validity() -> None:
    tracker = PresenceTracker(SECOND, 0)
    tracker.enter(SEEN, 0)
    assert tracker.enter(PENDING, DEFAULT_POLICY.valid_ns) is PRESENT
    assert tracker.enter(PENDING, DEFAULT_POLICY.valid_ns + 1) is UNKNOWN


def test_long_intervals_are_trusted_for_longer() -> None:
    tracker = PresenceTracker(60 * SECOND, 0)
    tracker.enter(SEEN, 0)
    assert tracker.enter(PENDING, 180 * SECOND) is PRESENT
    assert tracker.enter(PENDING, 180 * SECOND + 1) is UNKNOWN


@pytest.mark.parametrize(
    ("rounds", "doubt"),
    [((SEEN,), False), ((SEEN, MISSED), True), ((ABSENT,), False), ((ABSENT, SEEN), True)],
)
def test_doubt_is_one_round_that_disagrees(rounds: tuple[ProbeResult, ...], doubt: bool) -> None:
    tracker = PresenceTracker(SECOND, 0)
    run(*rounds, tracker=tracker)
    assert tracker.in_doubt is doubt


@given(st.lists(st.sampled_from([MISSED, ABSENT, PENDING, BLIND])))
def test_never_present_without_having_been_seen(rounds: list[ProbeResult]) -> None:
    assert PRESENT not in run(*rounds)
