from __future__ import annotations

import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import FIRST_PD
from eap.pd.address import SourceWatch
from eap.pd.frame_plan import FramePlan, RefusedPd, TakenPd, walk
from eap.pd.sequence import SequenceTracker, Timing
from eap.pd.words import Discard, RxWord
from tests.support.cyclic import PEER, octets

WATCH = SourceWatch(memoryview(b""), b"", frozenset())
TIMING = Timing(step=1, sender_cycle_ns=0, own_cycle_ns=1)


def tracker() -> SequenceTracker:
    return SequenceTracker(memoryview(bytearray(8 * RxWord.SIZE)).cast("q"), 0, TIMING)


def test_pds_side_by_side_here_and_there_are_copied_in_one_piece():
    one = tracker()
    pds = [(b"\x01\0\0\0\x02\0", 2), (b"\x02\0\0\0\x04\0", 4), (b"\x03\0\0\0\x01\0", 1)]
    plan = FramePlan(
        100,
        pds,
        [
            TakenPd(one, 0, source=14, target=200, size=10),
            TakenPd(one, 0, source=24, target=210, size=12),
            TakenPd(one, 0, source=36, target=300, size=9),
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
        100,
        [(b"\x01\0\0\0\0\0", 0), (b"\x02\0\0\0\0\0", 0)],
        [TakenPd(one, 3, 14, 200, 8), TakenPd(other, 4, 22, 208, 8)],
        [RefusedPd((1,))],
        watch=WATCH,
        roaming=[other],
        publisher=bytes([5, 23, 91, 23, 1, 1]),
    )
    assert [part for part, _ in plan.parts] == [one, other]
    assert plan.taken_words == (3, 4)
    assert plan.roaming == (other,)
    assert plan.publisher == 0x05175B170101


def test_headers_are_compared_without_their_quality():
    frame = octets([(1, b"ab", 7, 500), (2, b"", 3, 0)], publisher=PEER)
    plan = FramePlan(
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
    assert walked(FRAME, size) is Discard.TRUNCATED


def test_what_is_no_process_data_is_told_apart():
    assert walked(EtherCatHeader(0, 0, 1).encode() + bytes(20)) is Discard.WRONG_TYPE


def test_more_pds_than_fit_are_not_looked_for():
    many = bytearray(FRAME)
    many[8:10] = b"\xff\xff"
    assert walked(bytes(many)) is Discard.COUNT_TOO_LARGE
