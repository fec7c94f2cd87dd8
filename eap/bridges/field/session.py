"""Answers to one client of a server, independent of I/O: generators that yield writes."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import Any, Protocol, TypeAlias, TypeVar

ResultT = TypeVar("ResultT")
FieldAnswer: TypeAlias = Generator[Mapping[str, Any], str, ResultT]
"""Yields values to be written, by ``STATION/VARIABLE``, and is sent why that was refused, empty if
it was done."""


class FieldSession(Protocol):
    """One connection of a client."""

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the frame that *buffer* begins with, None until it is known.

        Raises:
            CodecError: it begins with no frame.
        """

    def answer(self, frame: bytes) -> FieldAnswer[bytes]:
        """Return the reply to one frame, empty for none.

        Raises:
            CodecError: it is no frame; the connection ends.
        """
