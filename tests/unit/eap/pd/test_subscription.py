from __future__ import annotations

import pytest

from eap.pd.poll import PollQuestion
from eap.pd.sequence import SequenceTracker, Timing
from eap.pd.spec import RxPdSpec, Substitute, TxFrameSpec, TxPdSpec, VariableSpec, Writer
from eap.pd.subscription import RxSubscription, SubstituteValue
from eap.pd.words import Discard, FrameWord
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
    question = PollQuestion(image.words, image.layout.tx[0], ["in"]) if polled else None
    made = RxSubscription(spec, slot, SubstituteValue(image, slot), question)
    timing = Timing(step=1, sender_cycle_ns=MS, own_cycle_ns=MS)
    made.tracker = SequenceTracker(image.words, slot.words, timing)
    return made, image.words


def test_version_and_length_have_to_fit():
    made, _ = subscription()
    assert made.mismatch(3, 2, b"") is None
    assert made.mismatch(4, 2, b"") is made.mismatch(4, 3, b"") is Discard.VERSION
    assert made.mismatch(3, 3, b"") is Discard.LENGTH


def test_the_version_may_be_of_no_interest_but_never_the_length():
    made, _ = subscription(ignore_version=True)
    assert made.mismatch(4, 2, b"") is None
    assert made.mismatch(4, 3, b"") is Discard.LENGTH


def test_what_comes_by_itself_is_too_old_when_nothing_has_come_for_so_long():
    made, _ = subscription()
    made.tracker.arrived(1, 10 * MS, 1)
    assert made.answer is None
    assert made.deadline_ns() == 15 * MS


def test_an_answer_is_too_old_when_it_was_asked_for_so_long_ago():
    made, words = subscription(polled=True)
    made.tracker.arrived(1, 10 * MS, 1)
    assert made.deadline_ns() is None
    words[made.answer.question._slot.frame_words + FrameWord.WHOLE] += 1
    made.answer.question.look(40 * MS)
    assert made.deadline_ns() == 45 * MS
    made.answer.question.answered("in", 41 * MS)
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
def test_substitute_replaces_the_data_and_nothing_else(substitute, values):
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
