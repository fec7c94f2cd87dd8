"""State of TxFrames and TxPDs: entered by publisher and answerer, read by people and programs.

What was not sent is entered with its time and never cleared, so that sending costs nothing more: a
reader compares the time with the one of the last that was sent.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from eap.pd.address import from_word
from eap.pd.image import Image
from eap.pd.layout import FrameSlot, TxSlot
from eap.pd.link import OutFrame
from eap.pd.monitor import SubscriberPresence
from eap.pd.words import FrameState, FrameWord, TxWord


def enter_sent(words: memoryview, pd: TxSlot, reason: int, now_ns: int) -> None:
    """Enter that *pd* was sent on its own, for *reason* (an index into REASONS)."""
    first = pd.words
    words[first + TxWord.REASON + reason] += 1
    words[first + TxWord.LAST_REASON] = reason
    words[first + TxWord.SENT_AT_NS] = now_ns


def enter_skipped(words: memoryview, pds: Iterable[TxSlot], now_ns: int) -> None:
    """Enter that *pds* were due and not sent."""
    for pd in pds:
        words[pd.words + TxWord.SKIPPED] += 1
        words[pd.words + TxWord.UNSENT_AT_NS] = now_ns


def enter_suppressed(words: memoryview, frame: FrameSlot, now_ns: int) -> None:
    """Enter that *frame* was due and suppressed."""
    _enter_unsent(words, frame, FrameState.NOT_SENT, now_ns)


def enter_refused(words: memoryview, frame: FrameSlot, out: OutFrame, now_ns: int) -> None:
    """Enter that a channel did not send *out*, which is *frame* or a part of it."""
    oversized = FrameState.OVERSIZED if out.oversized else 0
    _enter_unsent(words, frame, FrameState.NOT_SENT | oversized, now_ns)


def unsent_state(words: memoryview, first_word: int) -> FrameState:
    """Return why the frame whose first word is at index *first_word* was not sent, 0 if it was."""
    if words[first_word + FrameWord.UNSENT_AT_NS] < words[first_word + FrameWord.SENT_AT_NS]:
        return FrameState(0)
    return FrameState(words[first_word + FrameWord.UNSENT])


def tx_var_state(words: memoryview, pd: TxSlot) -> int:
    """Return VarState of *pd*: bit 0 not sent when it was due last."""
    unsent_at_ns = words[pd.words + TxWord.UNSENT_AT_NS]
    sent_at_ns = words[pd.words + TxWord.SENT_AT_NS]
    if words[pd.frame_words + FrameWord.WHOLE] and not pd.poll_request:
        # Its frame has gone whole: then all PDs of it are due in the same cycles.
        sent_at_ns = max(sent_at_ns, words[pd.frame_words + FrameWord.SENT_AT_NS])
    return int(unsent_at_ns > 0 and unsent_at_ns >= sent_at_ns)


def _enter_unsent(words: memoryview, frame: FrameSlot, state: FrameState, now_ns: int) -> None:
    words[frame.words + FrameWord.SKIPPED] += 1
    words[frame.words + FrameWord.UNSENT] = state
    words[frame.words + FrameWord.UNSENT_AT_NS] = now_ns


def frame_state(image: Image, first_word: int) -> int:
    """Return the FrameState of the frame whose first word is at index *first_word*."""
    is_missing = image.words[first_word + FrameWord.PRESENCE] == SubscriberPresence.MISSING
    missing = FrameState.SUBSCRIBER_MISSING if is_missing else 0
    return int(unsent_state(image.words, first_word) | missing)


def presence(image: Image, first_word: int) -> str:
    """Return whether the subscriber of that frame is there; ``unknown`` too without monitoring."""
    return SubscriberPresence(image.words[first_word + FrameWord.PRESENCE]).name.lower()


def frame_status(image: Image, slot: FrameSlot) -> dict[str, Any]:
    """Return one frame's entry of ``eapctl status``.

    ``address`` is where it goes at present, null while the one behind a NetID is not known.
    """
    words, first = image.words, slot.words
    address = from_word(words[first + FrameWord.ADDRESS])
    return {
        "name": slot.name,
        "port": slot.port,
        "destination": slot.destination,
        "address": None if address is None else str(address),
        "sent": words[first + FrameWord.WHOLE] + words[first + FrameWord.PARTIAL],
        "skipped": words[first + FrameWord.SKIPPED],
        "frame_state": frame_state(image, first),
        "monitor_interval_ms": slot.monitor_interval_ms or None,
        "subscriber": presence(image, first),
    }
