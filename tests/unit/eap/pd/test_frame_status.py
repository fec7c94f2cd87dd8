from __future__ import annotations

import pytest

from eap.pd.address import to_word
from eap.pd.frame_status import (
    enter_refused,
    enter_sent,
    enter_skipped,
    enter_suppressed,
    frame_state,
    frame_status,
    tx_var_state,
    unsent_state,
)
from eap.pd.image import Image
from eap.pd.layout import TxSlot
from eap.pd.link import OutFrame
from eap.pd.monitor import SubscriberPresence
from eap.pd.spec import RxPdSpec, TxFrameSpec, TxPdSpec
from eap.pd.words import REASON_INDEX, FrameState, FrameWord, Reason, TxWord
from tests.support.cyclic import image_of, received, station, written


@pytest.fixture
def image() -> Image:
    pds = (TxPdSpec("p", 1, ("x",)),)
    frames = (
        TxFrameSpec("f", "eap0", "10.0.0.9", pds, monitor_interval_ms=1000),
        TxFrameSpec("g", "eap0", "239.0.0.9", (TxPdSpec("q", 2, ("x",)),)),
    )
    return image_of(station(variables=written("x:UINT"), frames=frames))


def put(image: Image, **words: int) -> None:
    first = image.layout.frames[0].words
    for name, value in words.items():
        image.words[first + FrameWord[name]] = value


@pytest.mark.parametrize(
    ("state", "presence", "expected"),
    [
        (0, SubscriberPresence.UNKNOWN, 0),
        (0, SubscriberPresence.PRESENT, 0),
        (0, SubscriberPresence.MISSING, 4),
        (1, SubscriberPresence.MISSING, 5),
        (1, SubscriberPresence.UNKNOWN, 1),
    ],
)
def test_bit_2_of_the_state_is_subscriber_missing(
    image: Image, state: int, presence: SubscriberPresence, expected: int
) -> None:
    put(image, UNSENT=state, PRESENCE=presence)
    assert frame_state(image, image.layout.frames[0].words) == expected


def test_status_of_a_frame(image: Image) -> None:
    put(image, WHOLE=5, PARTIAL=2, SKIPPED=1, PRESENCE=1, ADDRESS=to_word("10.0.0.8:4000"))
    assert frame_status(image, image.layout.frames[0]) == {
        "name": "f",
        "port": "eap0",
        "destination": "10.0.0.9",
        "address": "10.0.0.8:4000",
        "sent": 7,
        "skipped": 1,
        "frame_state": 0,
        "monitor_interval_ms": 1000,
        "subscriber": "present",
    }


def test_nobody_is_looked_for_where_nothing_is_monitored(image: Image) -> None:
    row = frame_status(image, image.layout.frames[1])
    assert (row["monitor_interval_ms"], row["subscriber"]) == (None, "unknown")
    assert row["address"] is None


CHANGE = REASON_INDEX[Reason.CHANGE]


def outcome_image() -> tuple[Image, TxSlot, TxSlot]:
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
    made, p, _ = outcome_image()
    enter_sent(made.words, p, CHANGE, 700)
    enter_sent(made.words, p, CHANGE, 800)
    words = made.words[p.words : p.words + TxWord.SIZE]
    assert words[TxWord.REASON + CHANGE] == 2
    assert (words[TxWord.LAST_REASON], words[TxWord.SENT_AT_NS]) == (CHANGE, 800)
    assert tx_var_state(made.words, p) == 0


def test_a_pd_is_unsent_from_when_it_is_skipped_until_it_is_sent():
    made, p, q = outcome_image()
    assert tx_var_state(made.words, p) == 0
    enter_skipped(made.words, [p, q], 500)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    enter_sent(made.words, p, CHANGE, 600)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)
    assert made.words[q.words + TxWord.SKIPPED] == 1


def test_a_frame_that_goes_whole_sends_its_pds_but_none_that_is_polled():
    made, p, q = outcome_image()
    enter_skipped(made.words, [p, q], 500)
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 500  # with others, in the same cycle
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    made.words[p.frame_words + FrameWord.WHOLE] += 1
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 600
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)


def test_a_frame_says_why_it_was_not_sent_until_it_is():
    made, p, _ = outcome_image()
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
