"""What people and programs read of a TxFrame: where it goes, whether it left, who is there."""

from __future__ import annotations

from typing import Any

from eap.pd import outcome
from eap.pd.address import from_word
from eap.pd.image import Image
from eap.pd.layout import FramePlace
from eap.pd.presence import Presence
from eap.pd.words import FrameState, FrameWord


def frame_state(image: Image, first_word: int) -> int:
    """Return the FrameState of the frame whose first word is at index *first_word*."""
    is_missing = image.words[first_word + FrameWord.PRESENCE] == Presence.MISSING
    missing = FrameState.SUBSCRIBER_MISSING if is_missing else 0
    return int(outcome.frame_state(image.words, first_word) | missing)


def presence(image: Image, first_word: int) -> str:
    """Return whether the subscriber of that frame is there; ``unknown`` too if nobody looks."""
    return Presence(image.words[first_word + FrameWord.PRESENCE]).name.lower()


def frame_status(image: Image, place: FramePlace) -> dict[str, Any]:
    """Return one frame's entry of ``eapctl status``.

    ``address`` is where it goes at present, null while the one behind a NetID is not known.
    """
    words, first = image.words, place.words
    address = from_word(words[first + FrameWord.ADDRESS])
    return {
        "name": place.name,
        "port": place.port,
        "destination": place.destination,
        "address": None if address is None else str(address),
        "sent": words[first + FrameWord.WHOLE] + words[first + FrameWord.PARTIAL],
        "skipped": words[first + FrameWord.SKIPPED],
        "frame_state": frame_state(image, first),
        "monitor_interval_ms": place.monitor_interval_ms or None,
        "subscriber": presence(image, first),
    }
