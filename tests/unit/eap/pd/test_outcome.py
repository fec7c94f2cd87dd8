from __future__ import annotations

from eap.pd.frame_status import (
    enter_refused,
    enter_sent,
    enter_skipped,
    enter_suppressed,
    tx_var_state,
    unsent_state,
)
from eap.pd.image import Image
from eap.pd.layout import TxPlace
from eap.pd.link import OutFrame
from eap.pd.spec import RxPdSpec, TxFrameSpec, TxPdSpec
from eap.pd.words import REASON_INDEX, FrameState, FrameWord, Reason, TxWord
from tests.support.cyclic import image_of, received, station, written

CHANGE = REASON_INDEX[Reason.CHANGE]


def image() -> tuple[Image, TxPlace, TxPlace]:
    """A frame of a PD that is pushed and one that is polled."""
    made = image_of(
        station(
            variables=(*written("x:UINT"), *received("r:UINT")),
            subscriptions=(RxPdSpec("asked", "eap0", 9, ("r",)),),
            frames=(
                TxFrameSpec(
                    "f",
                    "eap0",
                    "10.0.0.1",
                    (TxPdSpec("p", 1, ("x",)), TxPdSpec("q", 2, ("x",), poll_request="asked")),
                ),
            ),
        )
    )
    return made, *made.layout.tx


def test_what_is_sent_on_its_own_tracker_is_counted_under_its_reason():
    made, p, _ = image()
    enter_sent(made.words, p, CHANGE, 700)
    enter_sent(made.words, p, CHANGE, 800)
    words = made.words[p.words : p.words + TxWord.SIZE]
    assert words[TxWord.REASON + CHANGE] == 2
    assert (words[TxWord.LAST_REASON], words[TxWord.SENT_AT_NS]) == (CHANGE, 800)
    assert tx_var_state(made.words, p) == 0


def test_a_pd_is_unsent_from_when_it_is_skipped_until_it_is_sent():
    made, p, q = image()
    assert tx_var_state(made.words, p) == 0
    enter_skipped(made.words, [p, q], 500)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    enter_sent(made.words, p, CHANGE, 600)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)
    assert made.words[q.words + TxWord.SKIPPED] == 1


def test_a_frame_that_goes_whole_sends_its_pds_but_none_that_is_polled():
    made, p, q = image()
    enter_skipped(made.words, [p, q], 500)
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 500  # with others, in the same cycle
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    made.words[p.frame_words + FrameWord.WHOLE] += 1
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 600
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)


def test_a_frame_says_why_it_was_not_sent_until_it_is():
    made, p, _ = image()
    (frame,) = made.layout.frames
    out = OutFrame(bytearray(20), 0, "10.0.0.1")
    assert unsent_state(made.words, p.frame_words) == 0
    enter_suppressed(made.words, frame, 500)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT
    out.oversized = True
    enter_refused(made.words, frame, out, 600)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT | FrameState.OVERSIZED
    out.oversized = False
    enter_refused(made.words, frame, out, 700)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 800
    assert unsent_state(made.words, p.frame_words) == 0
    assert made.words[p.frame_words + FrameWord.SKIPPED] == 3
