"""AoE packets in fragments, each way, as they pass between a client and a slave (ETG.1020).

Only the header in the first octets tells how long a packet is.  A fragment is acknowledged unless
its sender wants nothing: then the next one comes by itself.
"""

from __future__ import annotations

from eap.codec.ams import AmsCommand, AmsHeader, StateFlags

_ADDRESSES = 16
"""Octets of a header that every fragment repeats; the rest of the whole one comes as content."""
_LENGTH = slice(20, 24)
_FRAGMENT_NUMBER = 28
_NO_ANSWER = StateFlags.RESPONSE | StateFlags.NO_RETURN


class _Packet:
    """A packet of which fragments come.

    Attributes:
        header: Of the whole packet, as far as it came.
    """

    def __init__(self) -> None:
        self.header = b""
        self._octets = 0

    def take(self, fragment: bytes) -> bool:
        """Note the next fragment; return whether there is more to come."""
        content = fragment[AmsHeader.SIZE :]
        if not _number(fragment, _FRAGMENT_NUMBER):
            self.header, self._octets = fragment[:_ADDRESSES], 0
        self.header = (self.header + content)[: AmsHeader.SIZE]
        self._octets += len(content)
        if len(self.header) < AmsHeader.SIZE:
            return True
        length = int.from_bytes(self.header[_LENGTH], "little")
        return self._octets < AmsHeader.SIZE - _ADDRESSES + length


class AoeCourse:
    """How far one client and one slave are with their packets.

    Attributes:
        is_running: Whether fragments or acknowledgements of fragments are to come from the client.
        whole: Header of the packet that the last fragment has completed, by which its answer is
            known; empty if there is none.
        has_more: Whether the slave sends the next fragment by itself.
    """

    def __init__(self) -> None:
        self.is_running = False
        self.whole = b""
        self.has_more = False
        self._asked = _Packet()
        self._answered = _Packet()

    def ask(self, body: bytes) -> bool:
        """Note a request; return whether the slave answers it at all."""
        has_rest, self.is_running, self.whole = self.is_running, False, b""
        flags = _flags(body)
        if len(body) < AmsHeader.SIZE:
            return True
        if not _is_fragment(body):
            return not flags & _NO_ANSWER
        if flags & StateFlags.RESPONSE:  # it acknowledges a fragment, and the next one follows
            return has_rest
        self.is_running = self._asked.take(body)
        if self.is_running:
            return not flags & StateFlags.NO_RETURN
        self.whole = self._asked.header
        return not _flags(self.whole) & _NO_ANSWER

    def answer(self, body: bytes) -> None:
        """Note a reply."""
        self.has_more = False
        if not _is_fragment(body):
            self.is_running = False
        elif not _flags(body) & StateFlags.RESPONSE:
            self.is_running = self._answered.take(body)
            self.has_more = self.is_running and bool(_flags(body) & StateFlags.NO_RETURN)

    def is_step(self, body: bytes) -> bool:
        """Say that no packet is known to be repeated."""
        del body
        return False


def _number(body: bytes, at: int) -> int:
    return int.from_bytes(body[at : at + 2], "little")


def _is_fragment(body: bytes) -> bool:
    return _number(body, 16) == AmsCommand.FRAGMENT


def _flags(body: bytes) -> int:
    return _number(body, 18)
