"""AMS packets in frames of type 5: framing, datagrams and Ethernet; TCP is in mailbox_stream.

AoE to address 0 is for the router of a station; every other mailbox belongs to a bus, whose gateway
passes it on.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Protocol

from devicebus.mailbox.protocol import next_counter
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
from eap.pd.link import FrameChannel, FrameOrigin, OutFrame
from eap.runtime.discards import Refusal

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


class Ingress(Protocol):
    """Where packets of a channel go."""

    def receive(self, data: bytes, connection: str, *, for_all: bool = False) -> None:
        """Act on a packet that came from the address *connection*."""


class MailboxIntake:
    """One channel's frames for the stations behind it.

    Args:
        entrance: To these stations.
        gateway: For what is no AoE to a station; a frame for many is for no gateway.
        sender: Sends what the gateway answers.
        is_for_many: Tells of a frame whether it was meant for many.
        is_aoe_here: Whether AoE is for the stations; otherwise that is for the gateway too.
    """

    def __init__(
        self,
        demultiplexer: Ingress,
        gateway: FrameTaker,
        sender: ChannelSender,
        is_for_many: Callable[[memoryview], bool],
        *,
        is_aoe_here: bool = True,
    ) -> None:
        self._demultiplexer = demultiplexer
        self._gateway = gateway
        self._sender = sender
        self._is_for_many = is_for_many
        self._is_aoe_here = is_aoe_here

    def take(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> Refusal | None:
        """Act on a frame; return why not if it is not taken."""
        del at_ns
        sender = origin.sender_of(data)
        if not sender:
            return Refusal.MAILBOX
        frame, is_for_many = data[:size], self._is_for_many(data)
        packet = aoe_packet(frame) if self._is_aoe_here else None
        if packet is not None:
            self._demultiplexer.receive(packet, sender, for_all=is_for_many)
            return None
        if is_for_many:
            return refusal_of(frame)
        return self._gateway.receive(bytes(frame), sender, self._sender.send_frame)

    def admission(
        self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin
    ) -> Refusal | None:
        """Return why a frame is not taken that this intake gets too, without acting on it."""
        del at_ns, origin
        if aoe_packet(data[:size]) is not None:
            return None
        reason = refusal_of(data[:size])
        is_taken = self._gateway.is_there and not self._is_for_many(data)
        return None if is_taken and reason is Refusal.MAILBOX else reason


class ChannelSender:
    """Sends packets in frames to addresses that *channel* reaches."""

    def __init__(self, channel: FrameChannel) -> None:
        self._channel = channel
        self._counters = MailboxCounters()

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to the address *connection*; return why not if that cannot be done."""
        return self._send(connection, [self._counters.frame(connection, each) for each in packets])

    def send_frame(self, connection: str, frame: bytes) -> str | None:
        """Send a frame of type 5; returns as :meth:`send` does."""
        return self._send(connection, [frame])

    def _send(self, connection: str, frames: Sequence[bytes]) -> str | None:
        header = self._channel.link_header(connection)
        sent = []
        for frame in frames:
            buffer = bytearray(header + frame)
            if len(buffer) < self._channel.minimum_size:
                buffer += bytes(self._channel.minimum_size - len(buffer))
            sent.append(OutFrame(buffer, len(header), connection))
        failed = self._channel.send(sent, monotonic_ns())
        return "the network took no frame" if failed else None
