"""AMS packets in frames of type 5: what is for the router of a station, and how packets are packed.

That is AoE to address 0; every other mailbox belongs to a bus, whose gateway passes it on.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Protocol

from devicebus.mailbox.counter import next_counter
from eap.appliance.discards import Refusal
from eap.codec.ams import AmsHeader
from eap.codec.ethercat import EtherCatHeader
from eap.codec.mailbox import (
    MailboxHeader,
    MailboxType,
    aoe_packet_in,
    decode_frame,
    encode_plain_frame,
)
from eap.codec.wire import Buffer
from eap.errors import CodecError, MalformedError

FRAME_OVERHEAD = EtherCatHeader.SIZE + MailboxHeader.SIZE
_MAX_PEERS = 1024


class FrameTaker(Protocol):
    """Takes frames that are no AoE to a station: a gateway, if there is one."""

    @property
    def is_there(self) -> bool:
        """Whether there is any gateway."""

    def receive(
        self, frame: bytes, connection: str, send: Callable[[str, bytes], object]
    ) -> Refusal | None:
        """Act on a frame of *connection*, to which *send* sends; return why not if not taken."""

    def connection_closed(self, connection: str) -> None:
        """Forget who is gone."""

    def waiting(self, connection: str) -> int:
        """Return how many requests of a connection wait for their answers."""

    async def wait_below(self, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection wait."""


def aoe_packet(data: Buffer) -> bytes | None:
    """Return the AMS packet in a frame of type 5 that is for a station, None if it is for none."""
    packet = aoe_packet_in(data)
    return packet if packet is not None and len(packet) >= AmsHeader.SIZE else None


def refusal_of(data: Buffer) -> Refusal:
    """Return why nobody takes a frame of type 5 that is neither for a station nor for a gateway."""
    try:
        decode_frame(data)
    except MalformedError:
        return Refusal.MAILBOX  # of a protocol that nobody knows
    except CodecError:
        return Refusal.TRUNCATED
    return Refusal.MAILBOX


class MailboxCounters:
    """Counts the frames to each peer from 1 to 7, so that none is taken for a repeated one.

    What comes is not looked at for that: requests are told apart by who asks and by their numbers,
    and clients of their own making often leave the counter at 1.
    """

    def __init__(self) -> None:
        self._latest: OrderedDict[str, int] = OrderedDict()

    def frame(self, peer: str, packet: bytes) -> bytes:
        """Return the frame that brings *packet* to *peer*."""
        counter = next_counter(self._latest.pop(peer, 0))
        self._latest[peer] = counter
        if len(self._latest) > _MAX_PEERS:
            self._latest.popitem(last=False)
        return encode_plain_frame(MailboxType.AOE, 0, counter, packet)
