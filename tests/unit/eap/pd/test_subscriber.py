"""Which PDs are taken, why the others are not, and that nothing a peer sends does harm."""

from __future__ import annotations

import tracemalloc
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import EAP_SM_OFFSET, PdFrameHeader
from eap.ids import NetId
from eap.pd.poll import REQUESTERS_PER_CYCLE, PollRequests
from eap.pd.quality import quality
from eap.pd.report import station_status
from eap.pd.spec import RxAlternateSpec, RxPdSpec, SentVariableSpec, Substitute
from eap.pd.subscriber import Subscriber
from eap.pd.words import RxState, RxWord
from tests.support.cyclic import MS, OWN, PEER, SECOND, Receiver, give, octets, received
from tests.support.examples import examples

THIRD = "5.99.99.99.1.1"


def receiver(**options: object) -> Receiver:
    """One subscription *r*: PD 7 of PEER, version 3, two octets in x."""
    options = {"publisher": PEER, "version": 3, "step": 1, "sender_cycle_us": 1000} | options
    return Receiver(RxPdSpec("r", "eap0", 7, ("x",), **options), variables=received("x:UINT"))


def test_a_pd_that_fits_is_copied_to_its_variables():
    r = receiver()
    r.give(octets([(7, b"\x34\x12", 3)], cycle=9), MS)
    assert r.image.read("x") == 0x1234
    assert (r.word("r", RxWord.RECEIVED), r.word("r", RxWord.LAST_CYCLE)) == (1, 9)
    assert r.discarded() == {}


@pytest.mark.parametrize(
    ("frame", "reason", "per_subscription"),
    [
        (octets([(7, b"ab", 3)], publisher=THIRD), "wrong_publisher", 1),
        (octets([(8, b"ab", 3)]), "unknown_id", 0),
        (octets([(7, b"ab", 4)]), "version", 1),
        (octets([(7, b"abc", 3)]), "length", 1),
        (octets([(7, b"", 3)]), "length", 1),
        (octets([(7, b"ab", 3)])[:-1], "truncated", 0),
        (octets([(7, b"ab", 3)])[:1], "truncated", 0),
        (b"", "truncated", 0),
        (EtherCatHeader(5).encode() + bytes(5), "truncated", 0),
        (EtherCatHeader(21).encode() + PdFrameHeader(NetId.parse(PEER), 1, 0).encode()
         + b"\x07\0\x03\0\x02\0\0\0a", "truncated", 0),
        (EtherCatHeader(12).encode() + PdFrameHeader(NetId.parse(PEER), 1, 0).encode(),
         "count_too_large", 0),
        (EtherCatHeader(19).encode() + PdFrameHeader(NetId.parse(PEER), 65535, 0).encode()
         + bytes(7), "count_too_large", 0),
        (EtherCatHeader(21, type=7).encode() + bytes(21), "wrong_type", 0),
        (EtherCatHeader(21, type=5).encode() + bytes(21), "wrong_type", 0),
    ],
)  # fmt: skip
def test_subscriber_counts_dropped_pds_by_reason(frame, reason, per_subscription):
    r = receiver()
    for count in (1, 2):  # learned, then recognized
        r.give(frame, count * MS)
        assert r.discarded() == {reason: count}
        assert r.discarded("r") == ({reason: count} if per_subscription else {})
    assert r.word("r", RxWord.RECEIVED) == 0
    assert r.image.read("x") == 0


LENIENT_PDS = [(7, b"ab", 3), (8, b"cd", 0), (9, b"e", 0)]


@pytest.mark.parametrize("length", [0, 4, 13, 2047])
def test_lenient_port_takes_and_counts_frames_with_a_wrong_length(length):
    pd = RxPdSpec("r", "eap0", 7, ("x",), PEER, version=3, step=1, sender_cycle_us=1000)
    r = Receiver(pd, variables=received("x:UINT"), lenient=True)
    for cycle in (1, 2, 3):  # learned, then recognized
        right = octets(LENIENT_PDS, cycle=cycle)
        r.give(EtherCatHeader(length).encode() + right[2:], cycle * MS)
    assert r.image.read("x") == int.from_bytes(b"ab", "little")
    assert (r.word("r", RxWord.RECEIVED), r.word("r", RxWord.LOST)) == (3, 0)
    assert r.discarded("r") == {"wrong_length": 3}
    assert r.discarded() == {"wrong_length": 3, "unknown_id": 6}


def test_lenient_port_drops_what_is_cut_and_counts_no_right_frame():
    pd = RxPdSpec("r", "eap0", 7, ("x",), PEER, version=3)
    r = Receiver(pd, variables=received("x:UINT"), lenient=True)
    right = octets(LENIENT_PDS)
    for size in range(len(right)):
        r.give(EtherCatHeader(4).encode() + right[2:size], MS)
    assert set(r.discarded()) == {"truncated"}
    assert r.word("r", RxWord.RECEIVED) == 0
    r.give(right + b"padding", MS)
    assert r.word("r", RxWord.RECEIVED) == 1
    assert "wrong_length" not in r.discarded()


def test_layouts_with_a_wrong_length_are_learned_again_by_a_lenient_port_only():
    pd = RxPdSpec("r", "eap0", 7, ("x",), PEER, version=3)
    before = Receiver(pd, variables=received("x:UINT"), lenient=True)
    frame = EtherCatHeader(4).encode() + octets(LENIENT_PDS)[2:]
    before.give(frame, MS)
    for lenient in (True, False):
        after = Receiver(pd, variables=received("x:UINT"), lenient=lenient)
        after.subscriber.learn_from(before.subscriber)
        assert after.discarded() == {}
        after.give(frame, MS)
        assert after.word("r", RxWord.RECEIVED) == int(lenient)


def toggled(cycle: int, state: int) -> bytes:
    frame = bytearray(octets([(7, b"ab", 3)], cycle=cycle))
    frame[EAP_SM_OFFSET] = state
    return bytes(frame)


def test_toggle_bit_tells_repeated_frames_from_new_ones():
    r = receiver(step=0)
    sent = [(1, 0x28), (2, 0x08), (3, 0x28), (3, 0x28), (3, 0x08), (3, 0x08), (5, 0x08)]
    for number, (cycle, state) in enumerate(sent):
        r.give(toggled(cycle, state), number * MS)
    # The fourth and the sixth repeat the one before; the fifth is new though its counter is not.
    assert r.word("r", RxWord.REPEATED) == 2
    assert r.word("r", RxWord.DUPLICATED) == 2
    assert r.word("r", RxWord.RECEIVED) == len(sent)


@pytest.mark.parametrize("state", [0, 0x08, 0x28])
def test_sender_that_never_toggles_repeats_nothing(state):
    r = receiver(step=0)
    for number in range(6):
        r.give(toggled(number // 2, state), number * MS)
    assert (r.word("r", RxWord.REPEATED), r.word("r", RxWord.DUPLICATED)) == (0, 3)


def test_counter_that_stands_still_is_no_duplicate_while_the_bit_toggles():
    r = receiver(step=0)
    for number in range(6):
        r.give(toggled(0, 0x08 | number % 2 << 5), number * MS)
    assert (r.word("r", RxWord.REPEATED), r.word("r", RxWord.DUPLICATED)) == (0, 0)


def test_subscriber_reads_no_pd_behind_end_of_frame():
    frame = octets([(7, b"ab", 3)])
    r = receiver()
    r.give(frame, 0)
    r.give(frame[:-1], MS)  # the buffer behind it is long enough
    assert r.word("r", RxWord.RECEIVED) == 1
    assert r.discarded() == {"truncated": 1}


def test_surplus_octets_behind_the_last_pd_and_no_pds_at_all_are_fine():
    r = receiver()
    r.give(octets([]), 0)
    body = octets([(7, b"ab", 3)])[2:] + b"surplus"
    r.give(EtherCatHeader(len(body)).encode() + body, 0)
    r.give(octets([(7, b"cd", 3)], cycle=1) + b"padding", 0)
    assert r.word("r", RxWord.RECEIVED) == 2
    assert r.discarded() == {}


def test_the_state_byte_and_reserved_bits_are_no_reason_to_refuse():
    header = PdFrameHeader(NetId.parse(PEER), 1, 0, reserved=0xFF, eap_sm=0xFF).encode()
    body = header + octets([(7, b"ab", 3)])[14:]
    r = receiver()
    r.give(EtherCatHeader(len(body), reserved=1).encode() + body, 0)
    assert r.word("r", RxWord.RECEIVED) == 1


def test_the_version_can_be_ignored():
    r = receiver(ignore_version=True)
    r.give(octets([(7, b"ab", 9)]), 0)
    assert r.word("r", RxWord.RECEIVED) == 1


def test_subscriber_selects_alternate_by_version_and_length():
    other = RxAlternateSpec(2, (SentVariableSpec("", "BOOL"), SentVariableSpec("x", "UINT")))
    r = receiver(alternates=(other,))
    r.give(octets([(7, b"\xff\x34\x12", 2, 50)], cycle=1), MS)
    assert (r.image.read("x"), quality(r.image, r.slot("r"))) == (0x1234, 50)
    r.give(octets([(7, b"\x35\x12", 3, 0)], cycle=2), 2 * MS)
    assert (r.image.read("x"), quality(r.image, r.slot("r"))) == (0x1235, 0)
    for version, data in ((2, b"ab"), (3, b"abc"), (4, b"abc")):
        r.give(octets([(7, data, version)], cycle=3), 3 * MS)
    assert (r.word("r", RxWord.RECEIVED), r.word("r", RxWord.LOST)) == (2, 0)
    assert r.discarded("r") == {"version": 2, "length": 1}


def test_an_alternate_is_preferred_to_ignoring_the_version():
    other = RxAlternateSpec(2, (SentVariableSpec("y", "UINT"), SentVariableSpec("x", "UINT")))
    pd = RxPdSpec("r", "eap0", 7, ("x", "y"), version=3, ignore_version=True, alternates=(other,))
    r = Receiver(pd, variables=received("x:UINT", "y:UINT"))
    for version, values in ((3, [1, 2]), (2, [2, 1]), (4, [1, 2])):
        r.give(octets([(7, b"\1\0\2\0", version)]), 0)
        assert [r.image.read(name) for name in "xy"] == values


def test_an_older_frame_of_an_alternate_leaves_the_newer_data():
    r = receiver(alternates=(RxAlternateSpec(4, (SentVariableSpec("x", "UINT"),)),))
    for cycle, version, data in ((1, 4, b"aa"), (3, 3, b"cc"), (2, 4, b"bb")):
        r.give(octets([(7, data, version)], cycle=cycle), cycle * MS)
    assert r.image.read("x") == int.from_bytes(b"cc", "little")


def test_any_publisher_is_taken_each_with_its_own_counter():
    r = receiver(publisher="")
    for cycle, publisher in ((5, PEER), (500, THIRD), (503, THIRD), (6, PEER)):
        r.give(octets([(7, b"ab", 3)], cycle=cycle, publisher=publisher), cycle * MS)
    assert r.word("r", RxWord.RECEIVED) == 4
    assert r.word("r", RxWord.LOST) == 2
    assert r.word("r", RxWord.DUPLICATED) == r.word("r", RxWord.REORDERED) == 0


def test_any_publisher_is_still_known_after_a_restart():
    r = receiver(publisher="")
    r.give(octets([(7, b"ab", 3)], cycle=1), MS)
    r.start(2 * MS)
    r.give(octets([(7, b"ab", 3)], cycle=5), 5 * MS)
    assert r.word("r", RxWord.LOST) == 3


def test_every_subscription_that_fits_gets_the_pd():
    r = Receiver(
        RxPdSpec("named", "eap0", 7, ("x",), PEER),
        RxPdSpec("any", "eap0", 7, ("y",)),
        RxPdSpec("newer", "eap0", 7, ("z",), PEER, version=1),
        variables=received("x:UINT", "y:UINT", "z:UINT"),
    )
    r.give(octets([(7, b"\x05\0")]), 0)
    assert [r.image.read(name) for name in "xyz"] == [5, 5, 0]
    assert r.discarded() == {}  # somebody took it
    r.give(octets([(7, b"\x06\0", 1)]), MS)
    assert [r.image.read(name) for name in "xyz"] == [5, 5, 6]


def test_each_subscription_that_does_not_fit_counts_its_own_reason():
    r = Receiver(
        RxPdSpec("old", "eap0", 7, ("x",), PEER, version=1),
        RxPdSpec("long", "eap0", 7, ("y",), PEER, version=2),
        variables=received("x:UINT", "y:UDINT"),
    )
    r.give(octets([(7, b"ab", 2)]), 0)
    assert r.discarded("old") == {"version": 1}
    assert r.discarded("long") == {"length": 1}
    assert r.discarded() == {"version": 1}


def test_the_same_pd_twice_in_a_frame_is_one_arrival_with_the_last_data():
    r = receiver()
    r.give(octets([(7, b"ab", 3), (7, b"cd", 3)]), 0)
    assert r.image.read("x") == int.from_bytes(b"cd", "little")
    assert r.word("r", RxWord.RECEIVED) == 1


def test_var_state_reports_mismatch_until_pd_fits():
    r = receiver()

    def state() -> int:
        return station_status(r.image, 0)["pd"]["rx"][0]["var_state"]

    r.give(octets([(7, b"ab", 4)]), MS)
    assert state() == 1
    r.give(octets([(7, b"abc", 3)]), 2 * MS)
    assert state() == 2
    r.give(octets([(7, b"ab", 3)]), 3 * MS)
    assert state() == 0


def test_subscriber_drops_stale_frames_at_start_and_suppressed_after_stop():
    r = receiver()
    r.start(10 * MS)
    frame = octets([(7, b"ab", 3), (8, b"")])
    r.give(frame, 10 * MS - 1)
    assert (r.discarded(), r.discarded("r")) == ({"stale": 2}, {"stale": 1})
    r.give(frame, 10 * MS)
    assert r.word("r", RxWord.RECEIVED) == 1
    r.subscriber.close()
    r.give(frame, 11 * MS)
    assert r.discarded("r") == {"stale": 1, "suppressed": 1}
    assert r.subscriber.next_timeout() is None


def test_an_older_frame_leaves_the_newer_data():
    r = receiver()
    for cycle, data in ((1, b"aa"), (3, b"cc"), (2, b"bb")):
        r.give(octets([(7, data, 3)], cycle=cycle), cycle * MS)
    assert r.image.read("x") == int.from_bytes(b"cc", "little")


def test_time_out_applies_the_substitute_once_and_data_ends_it():
    r = receiver(timeout_ms=3, substitute=Substitute.ZERO)
    r.give(octets([(7, b"ab", 3)], cycle=1), 10 * MS)
    r.subscriber.handle_timeout(10 * MS)
    assert r.subscriber.next_timeout() == 13 * MS
    r.subscriber.handle_timeout(13 * MS - 1)
    assert (r.image.read("x") != 0, r.word("r", RxWord.STATE)) == (True, RxState.RUNNING)
    for now in (13, 14, 20, 30):
        r.subscriber.handle_timeout(now * MS)
    assert (r.image.read("x"), r.word("r", RxWord.STATE)) == (0, RxState.STALE)
    assert r.word("r", RxWord.TIMEOUTS) == 1
    r.give(octets([(7, b"\x09\0", 3)], cycle=40), 40 * MS)
    r.subscriber.handle_timeout(40 * MS)
    assert (r.image.read("x"), r.word("r", RxWord.STATE)) == (9, RxState.RUNNING)


def test_without_a_time_out_data_stays_for_ever():
    r = receiver()
    r.give(octets([(7, b"ab", 3)]), 0)
    for now_s in (0, 100, 100_000):
        r.subscriber.handle_timeout(now_s * SECOND)
    assert r.word("r", RxWord.STATE) == RxState.RUNNING
    assert r.subscriber.next_timeout() is None


def test_subscriber_without_data_does_not_time_out():
    r = receiver(timeout_ms=3)
    for now in range(20):
        r.subscriber.handle_timeout(now * MS)
    assert (r.word("r", RxWord.STATE), r.word("r", RxWord.TIMEOUTS)) == (RxState.WAITING, 0)


def test_a_time_out_is_found_though_an_engine_was_away():
    r = receiver(timeout_ms=3)
    r.give(octets([(7, b"ab", 3)]), 0)
    r.start(SECOND)
    r.subscriber.handle_timeout(SECOND)
    assert r.word("r", RxWord.STATE) == RxState.STALE


def test_frames_taken_outside_the_cycle_leave_the_sequence_word_even():
    r = receiver()
    words, sequence = r.image.words, 4
    r.give(octets([(7, b"ab", 3)]), 0)
    assert words[sequence] == 2
    words[sequence] = 3  # as inside a cycle
    r.give(octets([(7, b"ab", 3)], cycle=1), MS)
    assert words[sequence] == 3


def test_a_restarted_engine_keeps_every_counter_and_sees_the_gap():
    r = receiver()
    for cycle in (1, 2, 4, 4):
        r.give(octets([(7, b"ab", 3)], cycle=cycle), cycle * MS)
    r.give(octets([(7, b"ab", 9)]), 4 * MS)
    r.start(5 * MS)
    r.give(octets([(7, b"ab", 3)], cycle=10), 10 * MS)
    assert (r.word("r", RxWord.RECEIVED), r.word("r", RxWord.LOST)) == (5, 1 + 5)
    assert (r.word("r", RxWord.DUPLICATED), r.discarded("r")) == (1, {"version": 1})


def test_made_up_layouts_cost_bounded_memory_and_do_not_disturb_real_ones():
    r = receiver()
    made_up = [
        octets([((n * 97 + k) & 0xFFFF, b"", n & 0xFFFF) for k in range(100 + n % 80)])
        for n in range(400)
    ]
    tracemalloc.start()
    try:
        for n, frame in enumerate(made_up):
            r.give(frame, 0)
            r.give(octets([(7, b"ab", 3)], cycle=n), n * MS)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()
    assert (r.word("r", RxWord.RECEIVED), r.word("r", RxWord.LOST)) == (400, 0)


def test_subscriber_distinguishes_many_layouts_with_one_key():
    r = receiver()
    for n in range(100):
        r.give(octets([(1, b""), (7 if n % 3 else 1000 + n, b"ab", 3)], cycle=n), n * MS)
    assert r.word("r", RxWord.RECEIVED) == 66
    assert r.discarded() == {"unknown_id": 134}


@given(st.binary(max_size=80), st.integers(0, 0xF), st.booleans())
def test_garbage_is_counted_and_never_raises(noise, kind, whole):
    r = receiver()
    frame = EtherCatHeader(len(noise), type=kind).encode() + noise if whole else noise
    r.give(frame, 0)
    nothing_in_it = frame[8:10] == b"\0\0"
    assert sum(r.discarded().values()) + r.word("r", RxWord.RECEIVED) or nothing_in_it


@given(st.data())
def test_mutated_frames_are_taken_or_counted(data):
    good = octets([(7, b"ab", 3), (8, b"xyz", 1)], cycle=5)
    r = receiver()
    r.give(good, 0)
    frame = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(frame)))
    before = Counter(r.discarded()).total() + r.word("r", RxWord.RECEIVED)
    reordered = r.word("r", RxWord.REORDERED)
    r.give(bytes(frame[:cut]), MS)
    after = Counter(r.discarded()).total() + r.word("r", RxWord.RECEIVED)
    after += r.word("r", RxWord.REORDERED) - reordered
    empty = cut >= 14 and frame[8:10] == b"\0\0"
    assert after > before or empty


def test_the_own_port_is_no_special_case():
    r = receiver(publisher=OWN)
    give(r.subscriber.receive_frame, octets([(7, b"ab", 3)], publisher=OWN), 0)
    assert r.word("r", RxWord.RECEIVED) == 1


class Naive:
    """One PD alone, followed without any of the tricks: the plain rules of the counters."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.late: set[int] = set()
        self.counts: Counter[str] = Counter()

    def arrive(self, cycle: int) -> None:
        if not self.seen:
            self.counts["received"] += 1
        elif cycle > self.seen[-1]:
            self.counts["received"] += 1
            self.counts["lost"] += cycle - self.seen[-1] - 1
        elif cycle == self.seen[-1]:
            self.counts["received"] += 1
            self.counts["duplicated"] += 1
            return
        else:
            self.counts["reordered"] += 1
            if cycle not in self.late and cycle > self.seen[0] and cycle not in self.seen:
                self.counts["lost"] -= 1
            self.late.add(cycle)
            return
        self.seen.append(cycle)


NAMES = ("p0", "p1", "p2", "p3")


@examples(60, stateful_step_count=40)
class PartingTrackers(RuleBasedStateMachine):
    """PDs that share a tracker, part and are restarted count as if each had its own."""

    @initialize(first=st.integers(0, 0xFFFF))
    def begin(self, first: int) -> None:
        self.r = Receiver(
            *(
                RxPdSpec(name, "eap0", i, (name,), PEER, sender_cycle_us=1000, step=1)
                for i, name in enumerate(NAMES)
            ),
            variables=received(*(f"{name}:USINT" for name in NAMES)),
        )
        self.models = {name: Naive() for name in NAMES}
        self.data = dict.fromkeys(NAMES, 0)
        self.cycle = first
        self.withheld: list[tuple[int, tuple[int, ...]]] = []

    def deliver(self, cycle: int, pds: tuple[int, ...]) -> None:
        frame = octets([(i, bytes([cycle & 0xFF])) for i in pds], cycle=cycle & 0xFFFF)
        self.r.give(frame, self.cycle * MS)
        for i in pds:
            model = self.models[NAMES[i]]
            before = model.counts["received"]
            model.arrive(cycle)
            if model.counts["received"] > before:
                self.data[NAMES[i]] = cycle & 0xFF

    @rule(pds=st.sets(st.integers(0, 3), min_size=1), dropped=st.integers(0, 3))
    def a_frame_arrives(self, pds: set[int], dropped: int) -> None:
        self.cycle += 1 + dropped
        self.deliver(self.cycle, tuple(sorted(pds)))

    @rule()
    def all_arrive(self) -> None:
        self.cycle += 1
        self.deliver(self.cycle, (0, 1, 2, 3))

    @rule(pds=st.sets(st.integers(0, 3), min_size=1))
    def a_frame_is_doubled(self, pds: set[int]) -> None:
        self.cycle += 1
        self.deliver(self.cycle, tuple(sorted(pds)))
        self.deliver(self.cycle, tuple(sorted(pds)))

    @rule(pds=st.sets(st.integers(0, 3), min_size=1))
    def a_frame_is_overtaken(self, pds: set[int]) -> None:
        self.cycle += 2
        self.deliver(self.cycle, (0, 1, 2, 3))
        self.deliver(self.cycle - 1, tuple(sorted(pds)))

    @rule(cycles=st.integers(1, 200_000))
    def a_cable_is_cut(self, cycles: int) -> None:
        self.cycle += cycles

    @rule()
    def the_engine_is_restarted(self) -> None:
        self.r.start(0)

    @invariant()
    def every_pd_has_its_own_true_counters(self) -> None:
        for name, model in self.models.items():
            for counter in ("received", "lost", "duplicated", "reordered"):
                word = self.r.word(name, RxWord[counter.upper()])
                assert word == model.counts[counter], (name, counter)
            assert self.r.image.read(name) == self.data[name]


TestPartingTrackers = PartingTrackers.TestCase


def asking(*names: str) -> tuple[Receiver, PollRequests]:
    """A receiver of r and s, of which those called *names* are requests."""
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("x",), PEER),
        RxPdSpec("s", "eap0", 2, ("y",)),
        variables=received("x:UINT", "y:UINT"),
    )
    requests = PollRequests(names)
    pairs = zip(r.spec.subscriptions, r.image.layout.rx, strict=True)
    r.subscriber = Subscriber(r.image, list(pairs), MS, requests)
    r.subscriber.open(0)
    return r, requests


def test_a_request_is_noted_with_its_sender_and_taken_like_any_other_pd():
    r, requests = asking("r")
    for cycle in (1, 2):
        frame = octets([(1, b"ab"), (2, b"cd")], cycle=cycle)
        give(r.subscriber.receive_frame, frame, cycle * MS, "10.0.0.1:7")
        assert requests.pop_all() == {"10.0.0.1:7": {"r"}}
    give(r.subscriber.receive_frame, octets([(2, b"cd")], cycle=3), 3 * MS, "10.0.0.1:7")
    assert requests.pop_all() == {}
    assert (r.word("r", RxWord.RECEIVED), r.word("s", RxWord.RECEIVED)) == (2, 3)
    assert r.discarded() == {}


def test_a_request_that_is_not_taken_is_not_answered():
    r, requests = asking("r")
    r.give(octets([(1, b"ab")], cycle=9), MS)
    requests.pop_all()
    r.give(octets([(1, b"ab")], cycle=8), 2 * MS)  # reordered
    r.give(octets([(1, b"abc")], cycle=10), 3 * MS)
    r.subscriber.close()
    r.give(octets([(1, b"ab")], cycle=11), 4 * MS)
    assert requests.pop_all() == {}


def test_a_request_from_nowhere_is_counted_and_its_data_taken():
    r, requests = asking("r", "s")
    give(r.subscriber.receive_frame, octets([(1, b"ab"), (2, b"cd")], cycle=1), MS, "")
    assert requests.pop_all() == {}
    assert r.discarded() == {"no_sender": 2}
    assert r.discarded("r") == r.discarded("s") == {"no_sender": 1}
    assert r.image.read("x") == 0x6261


def test_requests_of_too_many_are_counted():
    r, requests = asking("s")
    for number in range(REQUESTERS_PER_CYCLE + 3):
        publisher = f"10.0.0.{number}.1.1"
        frame = octets([(2, b"cd")], cycle=7, publisher=publisher)
        give(r.subscriber.receive_frame, frame, MS, publisher)
    assert len(requests.pop_all()) == REQUESTERS_PER_CYCLE
    assert r.discarded() == r.discarded("s") == {"too_many_requests": 3}
    assert r.word("s", RxWord.RECEIVED) == REQUESTERS_PER_CYCLE + 3
