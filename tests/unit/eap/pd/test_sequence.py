"""Sequence counters of a sender, one frame at a time."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.pd.sequence import REORDER_WINDOW, SequenceTracker, Timing
from eap.pd.words import RxWord, histogram_bin
from tests.support.cyclic import MS, SECOND

COUNTERS = ("received", "lost", "duplicated", "reordered", "late")


class Book:
    """A tracker, fed one frame a millisecond unless a test says otherwise."""

    def __init__(self, *, step: int = 1, sender_cycle_ns: int = MS, polled: bool = False) -> None:
        self.words = memoryview(bytearray(8 * RxWord.SIZE * 2)).cast("q")
        self.timing = Timing(
            step=step, sender_cycle_ns=sender_cycle_ns, own_cycle_ns=MS, polled=polled
        )
        self.tracker = SequenceTracker(self.words, 0, self.timing)
        self.now = 0

    def feed(self, *cycles: int, every_ns: int = MS) -> list[bool]:
        taken = []
        for cycle in cycles:
            self.now += every_ns
            taken.append(self.tracker.arrived(cycle & 0xFFFF, self.now, 7))
        return taken

    def __getattr__(self, counter: str) -> int:
        return self.words[RxWord[counter.upper()]]

    def counts(self) -> tuple[int, ...]:
        return tuple(getattr(self, name) for name in COUNTERS)


def test_tracker_counts_frames_in_order_as_received_only():
    book = Book()
    assert not book.tracker.is_running
    assert book.feed(5, 6, 7) == [True] * 3
    assert book.counts() == (3, 0, 0, 0, 0)
    assert book.tracker.is_running
    assert (book.last_cycle, book.tracker.arrived_at_ns, book.arrived_in_cycle) == (7, 3 * MS, 7)


def test_tracker_counts_no_loss_before_first_frame():
    book = Book()
    book.feed(40_000)
    assert book.lost == 0


@pytest.mark.parametrize(
    ("step", "cycles", "lost"),
    [
        (1, (1, 2, 5), 2),
        (1, (65534, 1), 2),
        (3, (3, 6, 15), 2),
        (3, (65532, 2, 5), 1),  # 65532 + 6 = 65538, wrapped 2
        (10, (0, 10, 30, 40), 1),
    ],
)
def test_missing_steps_are_lost(step, cycles, lost):
    book = Book(step=step)
    book.feed(*cycles, every_ns=step * MS)
    assert book.lost == lost


def test_tracker_without_step_counts_no_loss():
    book = Book(step=0, sender_cycle_ns=MS)
    book.feed(1, 50, 51, 700)
    assert book.counts()[:4] == (4, 0, 0, 0)


def test_the_same_counter_again_is_duplicated_and_taken():
    book = Book()
    assert book.feed(1, 2, 2, 3) == [True] * 4
    assert book.counts()[:4] == (4, 0, 1, 0)


def test_a_terminal_that_never_counts_is_taken_each_time():
    book = Book(step=0, sender_cycle_ns=0)
    assert book.feed(*[0] * 10) == [True] * 10
    assert book.counts() == (10, 0, 9, 0, 0)


def test_an_older_frame_is_reordered_not_taken_and_no_longer_lost():
    book = Book()
    assert book.feed(1, 2, 4) == [True] * 3
    assert book.lost == 1
    assert book.feed(3) == [False]
    assert book.feed(5) == [True]
    assert book.counts()[:4] == (4, 0, 0, 1)
    assert book.last_cycle == 5


def test_tracker_late_duplicate_does_not_reduce_loss():
    book = Book()
    book.feed(1, 2, 4, 3, 3)
    assert book.counts()[:4] == (3, 0, 0, 2)


def test_any_number_of_frames_that_were_missed_may_come_late():
    book = Book()
    book.feed(1, 12)
    assert book.lost == 10
    assert book.feed(*range(2, 12)) == [False] * 10
    assert book.counts()[:4] == (2, 0, 0, 10)


def test_tracker_separates_holes_of_two_losses_across_wrap():
    book = Book(step=2)
    book.feed(65532, 65534, 2, 4, 10)  # 0, 6 and 8 are missing
    assert book.lost == 3
    assert book.feed(6, 0) == [False, False]
    assert (book.lost, book.reordered) == (1, 2)
    assert book.feed(7) == [False]  # no multiple of the step: it fills nothing
    assert (book.lost, book.reordered) == (1, 3)


def test_a_hole_farther_back_than_the_window_stays_lost():
    book = Book()
    book.feed(0, 2, *range(3, 3 + REORDER_WINDOW), 5 + REORDER_WINDOW)
    assert book.lost == 3
    book.feed(1)
    assert book.lost == 3


def test_tracker_takes_third_older_frame_for_restarted_sender():
    book = Book()
    assert book.feed(*range(20), 0, 1, 2, 3) == [True] * 20 + [False, False, True, True]
    assert book.counts()[:4] == (22, 0, 0, 2)
    assert book.last_cycle == 3


def test_tracker_good_frame_resets_count_of_older_frames():
    book = Book()
    taken = book.feed(10, 8, 9, 11, 9, 10, 12)
    assert taken == [True, False, False, True, False, False, True]


def test_an_older_frame_beyond_the_window_is_a_restarted_sender_at_once():
    book = Book()
    assert book.feed(1000, 1000 - REORDER_WINDOW - 1) == [True, True]
    assert book.reordered == 0
    assert book.feed(1000 - REORDER_WINDOW) == [True]
    assert book.lost == 0


def test_holes_from_before_a_restart_are_forgotten():
    book = Book()
    book.feed(100, 103)
    assert book.lost == 2
    book.feed(0, 1, 4)
    assert book.lost == 4
    assert book.feed(2) == [False]
    assert (book.lost, book.reordered) == (3, 1)


def test_the_counter_wraps_silently():
    book = Book()
    book.feed(*range(65530, 65545))
    assert book.counts()[:4] == (15, 0, 0, 0)
    assert book.last_cycle & 0xFFFF == 65544 - 65536


@pytest.mark.parametrize("cycles", [20_000, 40_000, 65_536, 65_537, 200_000, 1_000_001])
@pytest.mark.parametrize("step", [1, 7])
def test_gaps_longer_than_the_counter_are_resolved_by_the_time_of_arrival(cycles, step):
    book = Book(step=step)
    gap = cycles * step
    book.feed(3)
    book.now += gap * MS + MS // 3
    assert book.feed(3 + gap, every_ns=0) == [True]
    assert book.lost == cycles - 1
    assert book.duplicated == 0


def test_long_gaps_of_an_unknown_cycle_are_read_as_the_counter_says():
    book = Book(sender_cycle_ns=0)
    book.feed(0)
    assert book.feed(30_000, every_ns=3600 * 10**9) == [True]
    assert book.lost == 29_999
    book = Book(sender_cycle_ns=0)
    book.feed(30_000)
    assert book.feed(0) == [True]
    assert book.lost == 0


def test_lateness_is_more_than_one_own_cycle_after_the_expected_time():
    book = Book()
    book.feed(1)
    book.feed(2, every_ns=2 * MS)
    assert book.late == 0
    book.feed(3, every_ns=2 * MS + 1)
    assert book.late == 1
    book.feed(5, every_ns=3 * MS)  # one lost in between: it was expected later
    assert (book.late, book.lost) == (1, 1)


def test_jitter_is_the_distance_to_the_expected_time_either_way():
    book = Book()
    book.feed(1)
    book.feed(2, every_ns=MS + 30_000)
    book.feed(3, every_ns=MS - 200_000)
    book.feed(4, every_ns=61 * MS)
    bins = book.words[RxWord.JITTER : RxWord.JITTER + 64].tolist()
    expected = [0] * 64
    for micros in (30, 200, 60_000):
        expected[histogram_bin(micros)] += 1
    assert bins == expected
    assert book.jitter_max_us == 60_000


def test_jitter_needs_the_senders_cycle():
    book = Book(sender_cycle_ns=0)
    book.feed(1, 2, 3)
    assert not any(book.words[RxWord.JITTER : RxWord.SIZE])


def test_silence_is_entered_once_for_each_time_out():
    book = Book()
    book.feed(1)
    book.tracker.time_out()
    assert (book.tracker.is_running, book.timeouts) == (False, 1)
    book.feed(2)
    assert book.tracker.is_running


def test_parting_copies_the_history_and_then_each_counts_alone():
    book = Book()
    book.feed(1, 2, 4)
    other = book.tracker.part(book.words, RxWord.SIZE)
    assert book.words[:12].tolist() == [0] * 12  # what is the PD's own is not touched
    assert other.arrived(5, book.now + MS, 8)
    book.feed(3)
    second = book.words[RxWord.SIZE :]
    assert (second[RxWord.RECEIVED], second[RxWord.LOST]) == (4, 1)
    assert (book.received, book.lost, book.reordered) == (3, 0, 1)


def test_tracker_continues_state_of_earlier_engine():
    book = Book()
    book.feed(1, 2)
    book.tracker = SequenceTracker(book.words, 0, book.timing)
    book.feed(6)
    assert (book.received, book.lost) == (3, 3)


def test_another_sender_has_another_counter():
    book = Book()
    book.tracker.follow(11)
    book.feed(100)
    book.tracker.follow(22)
    assert book.feed(7) == [True]
    book.tracker.follow(22)
    book.feed(9)
    assert book.counts()[:4] == (3, 1, 0, 0)


@given(
    st.lists(st.sampled_from(["arrive", "drop", "twice"]), max_size=60),
    st.integers(0, 0xFFFF),
    st.integers(1, 5),
    st.integers(0, 4),
)
def test_every_pd_sent_between_the_first_and_the_last_is_accounted_for(fates, first, step, shift):
    """Received, lost and reordered add up, whatever is dropped, doubled and overtaken."""
    book = Book(step=step)
    arrivals = [(0, first)]
    for position, fate in enumerate(fates, 1):
        key = position + (shift + 0.5 if position % 7 == 3 else 0)
        arrivals += [(key, first + position * step)] * {"arrive": 1, "drop": 0, "twice": 2}[fate]
    arrivals.sort(key=lambda arrival: arrival[0])
    distinct = {cycle for _, cycle in arrivals}
    for key, cycle in arrivals:
        book.now = int(key * step * MS)
        book.tracker.arrived(cycle & 0xFFFF, book.now, 1)
    span = (max(distinct) - first) // step + 1
    assert book.lost == span - len(distinct)
    assert book.received + book.reordered == len(arrivals)


@given(
    st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(-MS, 10**12)), min_size=1, max_size=30),
    st.sampled_from([0, 1, 7]),
    st.sampled_from([0, MS, 250_000]),
)
def test_any_counters_and_times_are_taken_without_an_exception(frames, step, sender_cycle_ns):
    book = Book(step=step, sender_cycle_ns=sender_cycle_ns)
    for cycle, later_ns in frames:
        book.feed(cycle, every_ns=later_ns)
    assert book.received + book.reordered == len(frames)
    assert book.lost >= 0


def test_tracker_answer_is_late_after_next_sender_cycle():
    book = Book(sender_cycle_ns=4 * MS)
    book.tracker.enter_response(5 * MS)
    assert (book.late, book.jitter_max_us) == (0, 5000)
    book.tracker.enter_response(5 * MS + 1)
    book.tracker.enter_response(300_000)
    assert (book.late, book.jitter_max_us) == (1, 5000)
    bins = book.words[RxWord.JITTER : RxWord.SIZE].tolist()
    assert (bins[histogram_bin(5000)], bins[histogram_bin(300)]) == (2, 1)


def test_tracker_answers_without_sender_cycle_are_never_late():
    book = Book(sender_cycle_ns=0)
    book.tracker.enter_response(SECOND)
    assert book.late == 0


def test_answers_have_no_jitter_however_they_come():
    book = Book(step=0, polled=True)
    book.feed(1, 2, 9, every_ns=7 * MS)
    assert (book.received, book.lost, book.late, book.jitter_max_us) == (3, 0, 0, 0)


def test_tracker_has_taken_reports_last_frame():
    book = Book()
    assert book.feed(0x1_0005, 0x1_0006, 0x1_0005) == [True, True, False]
    assert book.tracker.has_taken(6)
    assert not book.tracker.has_taken(5)
