from __future__ import annotations

import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import FIRST_PD
from eap.pd.address import SourceWatch
from eap.pd.poll import OutgoingPoll
from eap.pd.sequence import SequenceTracker, Timing
from eap.pd.spec import RxPdSpec, Substitute, TxFrameSpec, TxPdSpec, VariableSpec, Writer
from eap.pd.subscription import (
    AcceptedPd,
    DroppedPd,
    FrameHead,
    FramePlan,
    RxSubscription,
    SubstituteValue,
    walk,
)
from eap.pd.words import FrameWord, PdDropReason, RxWord
from tests.support.cyclic import MS, PEER, Receiver, image_of, octets, received, station, written


def subscription(*, polled: bool = False, **options: object) -> tuple[RxSubscription, memoryview]:
    """A subscription to one UINT, with a time-out of 5 ms, and the words of its station."""
    spec = RxPdSpec("in", "eap0", 7, ("r",), PEER, version=3, timeout_ms=5, **options)
    image = image_of(
        station(
            variables=(*written("x:UINT"), *received("r:UINT")),
            frames=(TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("ask", 8, ("x",)),)),),
            subscriptions=(spec,),
        )
    )
    (slot,) = image.layout.rx
    poll = OutgoingPoll(image.words, image.layout.tx[0], ["in"]) if polled else None
    made = RxSubscription(spec, slot, SubstituteValue(image, slot), poll)
    timing = Timing(step=1, sender_cycle_ns=MS, own_cycle_ns=MS)
    made.tracker = SequenceTracker(image.words, slot.words, timing)
    return made, image.words


def test_version_and_length_have_to_fit():
    made, _ = subscription()
    assert made.mismatch(3, 2, b"") is None
    assert made.mismatch(4, 2, b"") is made.mismatch(4, 3, b"") is PdDropReason.VERSION
    assert made.mismatch(3, 3, b"") is PdDropReason.LENGTH


def test_the_version_may_be_of_no_interest_but_never_the_length():
    made, _ = subscription(ignore_version=True)
    assert made.mismatch(4, 2, b"") is None
    assert made.mismatch(4, 3, b"") is PdDropReason.LENGTH


def test_subscription_deadline_counts_from_last_arrival():
    made, _ = subscription()
    made.tracker.arrived(1, 10 * MS, 1)
    assert made.answer is None
    assert made.deadline_ns() == 15 * MS


def test_subscription_deadline_of_polled_pd_counts_from_request():
    made, words = subscription(polled=True)
    made.tracker.arrived(1, 10 * MS, 1)
    assert made.deadline_ns() is None
    words[made.answer.poll._slot.frame_words + FrameWord.WHOLE] += 1
    made.answer.poll.look(40 * MS)
    assert made.deadline_ns() == 45 * MS
    made.answer.poll.enter_answer("in", 41 * MS)
    assert made.deadline_ns() is None


DATA = bytes([0b1011, 0xAA, 0xBB])


@pytest.mark.parametrize(
    ("substitute", "values"),
    [
        (Substitute.HOLD, {"on": True, "mode": 5, "speed": 0xBBAA}),
        (Substitute.ZERO, {"on": False, "mode": 0, "speed": 0}),
        (Substitute.DEFAULT, {"on": False, "mode": 6, "speed": 1500}),
    ],
)
def test_substitute_replaces_data_only(substitute, values):
    variables = (
        VariableSpec("on", "BOOL", Writer.ENGINE),
        VariableSpec("mode", "BIT3", Writer.ENGINE, default=6),
        VariableSpec("speed", "UINT", Writer.ENGINE, default=1500),
        VariableSpec("next", "UINT", Writer.ENGINE, default=9),
    )
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("on", "mode", "speed"), substitute=substitute),
        RxPdSpec("s", "eap0", 2, ("next",)),
        variables=variables,
    )
    r.give(octets([(1, DATA, 0, 77)]), 0)
    slot = r.slot("r")
    header = bytes(r.image.memory[slot.offset : slot.offset + 8])
    SubstituteValue(r.image, slot).apply()
    assert r.image.read_all() | values == r.image.read_all()
    assert r.image.read("next") == 9
    assert bytes(r.image.memory[slot.offset : slot.offset + 8]) == header


PEER_ID = bytes([5, 23, 91, 23, 1, 1])
WATCH = SourceWatch(memoryview(b""), b"", frozenset())
TIMING = Timing(step=1, sender_cycle_ns=0, own_cycle_ns=1)


def tracker() -> SequenceTracker:
    return SequenceTracker(memoryview(bytearray(8 * RxWord.SIZE)).cast("q"), 0, TIMING)


def test_pds_side_by_side_here_and_there_are_copied_in_one_piece():
    one = tracker()
    pds = [(b"\x01\0\0\0\x02\0", 2), (b"\x02\0\0\0\x04\0", 4), (b"\x03\0\0\0\x01\0", 1)]
    plan = FramePlan(
        FrameHead(PEER_ID, 98),
        100,
        pds,
        [
            AcceptedPd(one, 0, source=14, target=200, size=10),
            AcceptedPd(one, 0, source=24, target=210, size=12),
            AcceptedPd(one, 0, source=36, target=300, size=9),
        ],
        [],
        watch=WATCH,
    )
    assert plan.parts == (
        (one, ((slice(14, 36), slice(200, 222)), (slice(36, 45), slice(300, 309)))),
    )


def test_each_tracker_has_its_own_copies():
    one, other = tracker(), tracker()
    plan = FramePlan(
        FrameHead(PEER_ID, 98),
        100,
        [(b"\x01\0\0\0\0\0", 0), (b"\x02\0\0\0\0\0", 0)],
        [AcceptedPd(one, 3, 14, 200, 8), AcceptedPd(other, 4, 22, 208, 8)],
        [DroppedPd((1,))],
        watch=WATCH,
        any_publisher=[other],
    )
    assert [part for part, _ in plan.parts] == [one, other]
    assert plan.accepted_words == (3, 4)
    assert plan.any_publisher == (other,)
    assert plan.publisher == 0x05175B170101


def test_headers_are_compared_without_their_quality():
    frame = octets([(1, b"ab", 7, 500), (2, b"", 3, 0)], publisher=PEER)
    plan = FramePlan(
        FrameHead(PEER_ID, len(frame) - 2),
        len(frame),
        [(b"\x01\0\x07\0\x02\0", 2), (b"\x02\0\x03\0\0\0", 0)],
        [],
        [],
        watch=WATCH,
    )
    assert plan.headers(frame, FIRST_PD) == plan.expected
    other = octets([(1, b"ab", 7, 0), (2, b"", 4, 0)], publisher=PEER)
    assert plan.headers(other, FIRST_PD) != plan.expected


FRAME = octets([(7, b"\x01\x02"), (8, b""), (9, b"\x03", 4)])


def walked(data: bytes, size: int | None = None):
    return walk(memoryview(data), len(data) if size is None else size)


def test_each_pd_with_its_slot():
    found = walked(FRAME + b"padding", len(FRAME))
    assert [(pd.pd_id, pd.version, pd.length, at) for pd, at in found] == [
        (7, 0, 2, FIRST_PD),
        (8, 0, 0, FIRST_PD + 10),
        (9, 4, 1, FIRST_PD + 18),
    ]


@pytest.mark.parametrize("size", range(len(FRAME)))
def test_every_frame_that_is_cut_off_is_dropped(size):
    assert walked(FRAME, size) is PdDropReason.TRUNCATED


def test_walk_reports_frames_without_process_data():
    assert walked(EtherCatHeader(0, 0, 1).encode() + bytes(20)) is PdDropReason.WRONG_TYPE


def test_more_pds_than_fit_are_not_looked_for():
    many = bytearray(FRAME)
    many[8:10] = b"\xff\xff"
    assert walked(bytes(many)) is PdDropReason.COUNT_TOO_LARGE
