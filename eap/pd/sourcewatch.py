"""The addresses that the frames of one publisher come from, and what is noted of them.

A publisher ID is no proof of identity: any host can put it into a frame.  Where the publisher's
address is known, its frames are told from those of all other hosts by that address.  Where it is
not, two hosts that send with one publisher ID are seen by the address that goes back and forth.
"""

from __future__ import annotations

from collections.abc import Iterable

from eap.pd.address import source_word
from eap.pd.words import RxWord

ALTERNATION_NS = 10_000_000_000
"""Two changes of the address within this time are two senders; a single one is a new address."""
_NEVER = -ALTERNATION_NS


class SourceWatch:
    """The source addresses of one publisher's frames, of one class.

    The addresses that subscriptions of the port expect are a class each, all others one together.

    Args:
        words: Of the process image.
        expected: The address that is this class; empty for all that nobody expects.
        named: The addresses that somebody expects.

    Attributes:
        source: The address of the last frame.
    """

    __slots__ = (
        "_changed_at_ns",
        "_expected",
        "_named",
        "_refusing",
        "_taking",
        "_words",
        "source",
    )

    def __init__(self, words: memoryview, expected: bytes, named: frozenset[bytes]) -> None:
        self.source: bytes | None = None
        self._words = words
        self._expected = expected
        self._named = named
        self._taking: set[int] = set()
        self._refusing: set[int] = set()
        self._changed_at_ns = _NEVER

    def follow(self, taking: Iterable[int], refusing: Iterable[int]) -> None:
        """Note addresses for more RxPDs too, given by their first words.

        Args:
            taking: Those that take PDs of these frames.
            refusing: Those that refuse PDs because of where these frames come from.
        """
        self._taking.update(taking)
        self._refusing.update(refusing)
        if self.source is not None:
            self._note(source_word(self.source))

    def includes(self, source: bytes, at_ns: int) -> bool:
        """Tell whether a frame from *source* is of this class, and note it if the address is new.

        Only called for another address than :attr:`source`.
        """
        if (source if source in self._named else b"") != self._expected:
            return False
        before, self.source = self.source, source
        self._note(source_word(source))
        if before is not None:
            if at_ns - self._changed_at_ns < ALTERNATION_NS:
                other = source_word(before)
                for first in self._taking:
                    self._words[first + RxWord.OTHER_SOURCE] = other
                    self._words[first + RxWord.OTHER_SOURCE_AT_NS] = at_ns
            self._changed_at_ns = at_ns
        return True

    def _note(self, word: int) -> None:
        for first in self._taking:
            self._words[first + RxWord.SOURCE] = word
        for first in self._refusing:
            self._words[first + RxWord.WRONG_SOURCE] = word
