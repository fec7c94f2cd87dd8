"""Frames of a cycle, encoded once: each cycle patches their index and the outputs.

Their replies are compared with the headers as they were sent, without decoding them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from devicebus.wire.datagram import OVERHEAD, Command, DatagramHeader, DatagramRequest
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import Buffer

MAX_DATAGRAMS = 15
"""Datagrams in a frame: some slaves and masters support no more."""
MAX_BODY = 1498
"""Bytes of a frame without its header: the capacity of an Ethernet frame."""
FIXED_ADP = frozenset(
    (Command.FPRD, Command.FPWR, Command.FPRW, Command.FRMW, Command.LRD, Command.LWR, Command.LRW)
)
"""Commands whose ADP no slave changes; others increment it on the way."""

_LAYOUT = DatagramHeader.LAYOUT
_TYPE_WORD = FrameType.DATAGRAM << 12
_MORE = 0x8000
_MORE_HIGH, _LENGTH_HIGH = 0x80, 0x07
"""Bits of the high byte of the length word; the circulating bit is changed on the way."""


def encode_datagrams(datagrams: Sequence[DatagramRequest], index: int) -> bytes:
    """Return the datagrams as the last ones of a frame, each with *index*."""
    parts: list[bytes] = []
    last = len(datagrams) - 1
    for number, each in enumerate(datagrams):
        word = len(each.data) | (_MORE if number < last else 0)
        head = _LAYOUT.pack(each.command, index, each.adp, each.ado, word, 0)
        parts += (head, each.data, b"\0\0")
    return b"".join(parts)


def encode_header(body_size: int) -> bytes:
    """Return the EtherCAT header in front of *body_size* bytes of datagrams."""
    return (body_size | _TYPE_WORD).to_bytes(2, "little")


class _Head(NamedTuple):
    """Header of a datagram as it must come back, without index, event bits and counter."""

    at: int
    command: int
    address: bytes
    """ADP and ADO, or ADO alone if slaves increment ADP."""
    address_at: int
    length: int
    length_high: int
    """Low byte of the length, and its high bits."""


class PreparedFrame:
    """Datagrams that one frame of each cycle carries.

    Args:
        datagrams: At least one, no more than fit a frame; their data is what is sent first.

    Attributes:
        octets: The frame, from its EtherCAT header on; the owner writes the outputs there.
        size: Its length in bytes.
        places: Where the data of each datagram begins, and where its working counter is.
    """

    __slots__ = ("_heads", "_index_at", "_more_at", "octets", "places", "size")

    def __init__(self, datagrams: Sequence[DatagramRequest]) -> None:
        body = encode_datagrams(datagrams, 0)
        self.octets = bytearray(encode_header(len(body)) + body)
        self.size = len(self.octets)
        self.places: list[tuple[int, int]] = []
        self._heads: list[_Head] = []
        at = EtherCatHeader.SIZE
        for each in datagrams:
            first = at + (2 if each.command in FIXED_ADP else 4)
            address = bytes(self.octets[first : at + 6])
            size = len(each.data)
            self._heads.append(_Head(at, int(each.command), address, first, size & 0xFF, size >> 8))
            start = at + DatagramHeader.SIZE
            self.places.append((start, start + size))
            at += OVERHEAD + size
        self._index_at = [head.at + 1 for head in self._heads]
        self._more_at = self._heads[-1].at + 7

    def encode(self, index: int, more: bytes = b"") -> bytes:
        """Return the frame with *index*, followed by further encoded datagrams."""
        octets = self.octets
        for at in self._index_at:
            octets[at] = index
        if not more:
            return bytes(octets)
        frame = octets + more
        frame[:2] = encode_header(len(frame) - EtherCatHeader.SIZE)
        frame[self._more_at] |= _MORE_HIGH
        return bytes(frame)

    def matches(self, data: Buffer, index: int) -> bool:
        """Return whether *data* is this frame, sent with *index*, as slaves send it back."""
        if len(data) < self.size or data[1] >> 4 != FrameType.DATAGRAM:
            return False
        for at, command, address, address_at, length, length_high in self._heads:
            if (
                data[at] != command
                or data[at + 1] != index
                or data[address_at : at + 6] != address
                or data[at + 6] != length
                or data[at + 7] & _LENGTH_HIGH != length_high
            ):
                return False
        return True


def prepare_frames(datagrams: Sequence[DatagramRequest]) -> list[PreparedFrame]:
    """Return frames for the datagrams in their order, as many in each as fit."""
    frames: list[PreparedFrame] = []
    members: list[DatagramRequest] = []
    size = 0
    for each in datagrams:
        octets = OVERHEAD + len(each.data)
        if members and (size + octets > MAX_BODY or len(members) == MAX_DATAGRAMS):
            frames.append(PreparedFrame(members))
            members, size = [], 0
        members.append(each)
        size += octets
    return [*frames, PreparedFrame(members)] if members else frames


class CyclicExchange:
    """Frames of one cycle, whose replies are reported together.

    Args:
        frames: The frames to send, with the outputs of this cycle.
        number: Number of the cycle.
        begun_ns: Time at which it was queued.
        allowed: Working counters that each datagram may have, as bit sets.
        done: Called once: when all frames are back, or when one is lost.

    Attributes:
        replies: Frames that came back; empty before.
        missing: Number of frames that are not back.
        is_overdue: True if a frame has not come back in time.
        is_lost: True if a frame never came back.
    """

    __slots__ = (
        "_done", "allowed", "begun_ns", "frames", "is_lost", "is_overdue", "missing", "number",
        "replies",
    )  # fmt: skip

    def __init__(
        self,
        frames: Sequence[PreparedFrame],
        number: int,
        begun_ns: int,
        allowed: tuple[int, ...],
        done: Callable[[CyclicExchange, int], None],
    ) -> None:
        self.frames = frames
        self.number = number
        self.begun_ns = begun_ns
        self.allowed = allowed
        self.missing = len(frames)
        self.replies: list[bytes] = [b""] * len(frames)
        self.is_overdue = False
        self.is_lost = False
        self._done = done

    def take(self, number: int, data: bytes, now_ns: int) -> None:
        """Take the reply to frame *number*."""
        self.replies[number] = data
        self.missing -= 1
        if not self.missing and not self.is_lost:
            self._done(self, now_ns)

    def lose(self, now_ns: int) -> None:
        """Note that a frame never came back."""
        if not self.is_lost:
            self.is_lost = True
            self._done(self, now_ns)
