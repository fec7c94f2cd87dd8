"""Ethernet frames in the fragments of EoE, for both sides (ETG.1000.6)."""

from __future__ import annotations

from collections.abc import Iterator

from eap.codec.eoe import (
    FRAGMENT_UNIT,
    EoeHeader,
    EoeType,
    FragmentWord,
)
from eap.errors import CodecError, MalformedError

MAX_FRAME = 1522
"""Octets of the longest Ethernet frame, with a VLAN tag and without check sequence, rounded up."""
_TIME_SIZE = 4
_WORDS = EoeHeader.SIZE + FragmentWord.SIZE


def iter_fragments(frame: bytes, number: int, room: int, *, port: int = 0) -> Iterator[bytes]:
    """Yield the messages that carry *frame*, each with at most *room* octets of it.

    Args:
        frame: An Ethernet frame without check sequence.
        number: From 0 to 15, another one for each frame.
        room: Octets of a message behind the two words of EoE; at least 32, unless all fits in one.
        port: Of the slave; 0 for any.

    Raises:
        CodecError: the frame is too long, or its fragments do not fit.
    """
    if not 0 < len(frame) <= MAX_FRAME:
        raise CodecError(f"a frame of {len(frame)} octets, expected 1 to {MAX_FRAME}",
                         layout="EoeHeader")  # fmt: skip
    step = room if room >= len(frame) else room // FRAGMENT_UNIT * FRAGMENT_UNIT
    if not step:
        raise CodecError(f"room for {room} octets, expected 32", layout="EoeHeader")
    units = (len(frame) + FRAGMENT_UNIT - 1) // FRAGMENT_UNIT
    for fragment, start in enumerate(range(0, len(frame), step)):
        piece = frame[start : start + step]
        last = start + step >= len(frame)
        offset = start // FRAGMENT_UNIT if fragment else units
        word = FragmentWord(fragment, offset, number)
        yield EoeHeader(EoeType.FRAGMENT, port, last).encode() + word.encode() + piece


class Assembler:
    """Puts fragments together again, one frame at a time.

    Attributes:
        dropped: Frames of which fragments were missing or did not fit together.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._content: bytearray | None = None
        self._number = 0
        self._next = 0
        self._dropped_number = -1

    def reset(self) -> None:
        """Forget the frame that is not complete."""
        self._content = None

    def receive(self, message: bytes) -> bytes | None:
        """Take a message of type FRAGMENT; return the frame that it completes, if it does.

        Raises:
            CodecError: the message is too short.
        """
        header = EoeHeader.decode(message)
        word = FragmentWord.decode(message, EoeHeader.SIZE)
        data = message[_WORDS:]
        if header.last and header.time_appended:
            if len(data) < _TIME_SIZE:
                raise MalformedError("no room for the time that is appended", layout="EoeHeader")
            data = data[:-_TIME_SIZE]
        if word.fragment == 0:
            if self._content is not None:
                self._drop(self._number)
            self._content = bytearray()
            self._number, self._next, self._dropped_number = word.frame, 0, -1
        if self._content is not None and not self._fits(word, data):
            self._drop(self._number)
        if self._content is None:
            self._drop(word.frame)
            return None
        self._content += data
        self._next += 1
        if not header.last:
            return None
        frame, self._content = bytes(self._content), None
        return frame

    def _fits(self, word: FragmentWord, data: bytes) -> bool:
        content = self._content or b""
        if (word.frame, word.fragment) != (self._number, self._next):
            return False
        is_in_place = word.fragment == 0 or word.offset * FRAGMENT_UNIT == len(content)
        return is_in_place and len(content) + len(data) <= MAX_FRAME

    def _drop(self, number: int) -> None:
        self._content = None
        self.dropped += number != self._dropped_number
        self._dropped_number = number
