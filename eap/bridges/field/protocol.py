"""Parts of a protocol, independent of I/O: conversations with controllers, answers to clients.

Both are generators.  A driver sends the frames that a conversation yields, and sends the replies
into it; an answer yields values to be written.  ``return`` has the result.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar

from eap.bridges.field.plan import ReadSpan, SpanLimits
from eap.codec.fieldaddresses import FieldPoint
from eap.errors import ProtocolError

ResultT = TypeVar("ResultT")
FieldConversation: TypeAlias = Generator[bytes, bytes, ResultT]
"""Yields frames, and is sent the reply to each."""
FieldAnswer: TypeAlias = Generator[Mapping[str, Any], str, ResultT]
"""Yields values to be written, by ``STATION/VARIABLE``, and is sent why that was refused, empty if
it was done."""


class FieldLinkError(ProtocolError):
    """A controller broke the protocol or refuses to talk; the connection has no use any more."""


class FieldLink(Protocol):
    """One connection to a controller.

    Attributes:
        limits: Limits of spans; valid when the conversation of :meth:`open` has ended.
    """

    limits: SpanLimits

    def frame_length(self, buffer: bytes) -> int | None:
        """Return the length of the frame that *buffer* begins with, None until it is known.

        Raises:
            CodecError: it begins with no frame.
        """

    def open(self) -> FieldConversation[None]:
        """Begin the connection; raises CodecError or FieldLinkError if that fails."""

    def fits(self, spans: Sequence[ReadSpan]) -> bool:
        """Return whether *spans* can be read by one request."""

    def read(self, spans: Sequence[ReadSpan]) -> FieldConversation[list[bytes | str]]:
        """Read spans; the result has for each its bytes, or why it cannot be read."""

    def write(self, point: FieldPoint, data: bytes) -> FieldConversation[str]:
        """Write one value; the result is why it was refused, empty if it was done."""


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
