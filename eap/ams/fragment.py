"""AMS packets in the fragments of AoE, for both sides (ETG.1020).

Each fragment is a packet of its own, with the addresses of the whole one; the first carries the
rest of its header, from the command on, in front of the data.  The invoke id is the number of the
fragment, and that of the packet above it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.errors import MalformedError
from eap.ids import NetId

FRAGMENT_TIMEOUT_NS = 2_000_000_000
"""How long the next fragment may take; what came before is forgotten then."""
MAX_PACKETS = 8
"""Packets of which fragments are kept at a time; the oldest makes room."""
MAX_LENGTH = 1 << 20
"""Octets of the longest packet that is put together."""
_ADDRESSES = 16
"""Octets of a header that every fragment repeats."""
_REST = AmsHeader.SIZE - _ADDRESSES


def iter_fragments(packet: bytes, number: int, room: int) -> Iterator[bytes]:
    """Yield the packets that carry *packet*, each with at most *room* octets of it.

    Nobody acknowledges them.

    Args:
        packet: A whole packet.
        number: Of the packet, another one for each; 16 bits count.
        room: Octets behind the header of each.
    """
    header = AmsHeader.decode(packet)
    content = packet[_ADDRESSES:]
    for fragment, at in enumerate(range(0, len(content), room)):
        head = AmsHeader(
            header.target,
            header.target_port,
            header.source,
            header.source_port,
            AmsCommand.FRAGMENT,
            StateFlags.ADS | StateFlags.NO_RETURN,
            invoke_id=(number & 0xFFFF) << 16 | fragment,
        )
        yield encode_packet(head, content[at : at + room])


class _Partial:
    """What came so far of one packet."""

    __slots__ = ("content", "deadline_ns", "next")

    def __init__(self) -> None:
        self.content = bytearray()
        self.next = 0
        self.deadline_ns = 0


class Taken(NamedTuple):
    """What a fragment leads to."""

    packet: bytes | None
    """The whole packet, if this was its last fragment."""
    acknowledgement: bytes | None
    """What the sender waits for before it sends the next."""


class Assembler:
    """Puts fragments together again.

    Attributes:
        dropped: Packets of which fragments were missing, late, or did not fit together.
        octets: Kept of the packets that are not complete.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.octets = 0
        self._partial: dict[tuple[int, NetId, int], _Partial] = {}

    def reset(self) -> None:
        """Forget the packets that are not complete."""
        self._partial.clear()
        self.octets = 0

    def __len__(self) -> int:
        return len(self._partial)

    def receive(self, header: AmsHeader, body: bytes, now_ns: int) -> Taken:
        """Take the fragment with *header* and *body*.

        Raises:
            MalformedError: one before it is missing, or the whole is longer than it says.
        """
        number, fragment = header.invoke_id >> 16, header.invoke_id & 0xFFFF
        key = number, header.source, header.source_port
        self.expire(now_ns)
        if fragment == 0:
            self._start(key)
        partial = self._partial.get(key)
        if partial is None or partial.next != fragment:
            self._drop(key)
            raise MalformedError(f"fragment {fragment} of packet {number} out of order",
                                 layout="AmsHeader")  # fmt: skip
        partial.content += body
        self.octets += len(body)
        partial.next += 1
        partial.deadline_ns = now_ns + FRAGMENT_TIMEOUT_NS
        missing = _missing(partial.content)
        if missing < 0:
            self._drop(key)
            raise MalformedError(f"packet {number} is {-missing} octets too long",
                                 layout="AmsHeader")  # fmt: skip
        if missing:
            return Taken(None, _acknowledge(header))
        self._forget(key)
        return Taken(header.encode()[:_ADDRESSES] + bytes(partial.content), None)

    def expire(self, now_ns: int) -> None:
        """Forget the packets whose next fragment is late."""
        for key in [key for key, each in self._partial.items() if now_ns > each.deadline_ns]:
            self._drop(key)

    def _start(self, key: tuple[int, NetId, int]) -> None:
        if key in self._partial:
            self._drop(key)
        elif len(self._partial) >= MAX_PACKETS:
            self._drop(next(iter(self._partial)))
        self._partial[key] = _Partial()

    def _drop(self, key: tuple[int, NetId, int]) -> None:
        self._forget(key)
        self.dropped += 1

    def _forget(self, key: tuple[int, NetId, int]) -> None:
        partial = self._partial.pop(key, None)
        if partial is not None:
            self.octets -= len(partial.content)


def _missing(content: bytearray) -> int:
    """Return how many octets are still to come; at least one while nobody can know."""
    if len(content) < _REST:
        return _REST - len(content)
    length = int.from_bytes(content[4:8], "little")
    if length > MAX_LENGTH:
        return MAX_LENGTH - length
    return _REST + length - len(content)


def _acknowledge(header: AmsHeader) -> bytes | None:
    if header.state_flags & StateFlags.NO_RETURN:
        return None
    return AmsHeader(
        header.source,
        header.source_port,
        header.target,
        header.target_port,
        header.command,
        header.state_flags | StateFlags.RESPONSE,
        invoke_id=header.invoke_id,
    ).encode()
