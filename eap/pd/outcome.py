"""What became of frames and PDs that were due: the words in which publisher and answerer enter it.

What was not sent is entered with its time and never cleared, so that sending costs nothing more: a
reader compares the time with the one of the last that was sent.
"""

from __future__ import annotations

from collections.abc import Iterable

from eap.pd.layout import FramePlace, TxPlace
from eap.pd.link import OutFrame
from eap.pd.words import FrameState, FrameWord, TxWord


def enter_sent(words: memoryview, pd: TxPlace, reason: int, now_ns: int) -> None:
    """Enter that *pd* was sent on its own account, for *reason* (an index into REASONS)."""
    first = pd.words
    words[first + TxWord.REASON + reason] += 1
    words[first + TxWord.LAST_REASON] = reason
    words[first + TxWord.SENT_AT_NS] = now_ns


def enter_skipped(words: memoryview, pds: Iterable[TxPlace], now_ns: int) -> None:
    """Enter that *pds* were due and not sent."""
    for pd in pds:
        words[pd.words + TxWord.SKIPPED] += 1
        words[pd.words + TxWord.UNSENT_AT_NS] = now_ns


def enter_suppressed(words: memoryview, frame: FramePlace, now_ns: int) -> None:
    """Enter that *frame* was due and suppressed."""
    _enter_unsent(words, frame, FrameState.NOT_SENT, now_ns)


def enter_refused(words: memoryview, frame: FramePlace, out: OutFrame, now_ns: int) -> None:
    """Enter that a channel did not send *out*, which is *frame* or a part of it."""
    oversized = FrameState.OVERSIZED if out.oversized else 0
    _enter_unsent(words, frame, FrameState.NOT_SENT | oversized, now_ns)


def frame_state(words: memoryview, first_word: int) -> FrameState:
    """Return why the frame whose first word is at index *first_word* was not sent, 0 if it was."""
    if words[first_word + FrameWord.UNSENT_AT_NS] < words[first_word + FrameWord.SENT_AT_NS]:
        return FrameState(0)
    return FrameState(words[first_word + FrameWord.UNSENT])


def var_state(words: memoryview, pd: TxPlace) -> int:
    """Return VarState of *pd*: bit 0 not sent when it was due last."""
    unsent_at_ns = words[pd.words + TxWord.UNSENT_AT_NS]
    sent_at_ns = words[pd.words + TxWord.SENT_AT_NS]
    if words[pd.frame_words + FrameWord.WHOLE] and not pd.poll_request:
        # Its frame has gone whole: then all PDs of it are due in the same cycles.
        sent_at_ns = max(sent_at_ns, words[pd.frame_words + FrameWord.SENT_AT_NS])
    return int(unsent_at_ns > 0 and unsent_at_ns >= sent_at_ns)


def _enter_unsent(words: memoryview, frame: FramePlace, state: FrameState, now_ns: int) -> None:
    words[frame.words + FrameWord.SKIPPED] += 1
    words[frame.words + FrameWord.UNSENT] = state
    words[frame.words + FrameWord.UNSENT_AT_NS] = now_ns
