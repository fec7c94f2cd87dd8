"""Frames of type 5 as datagrams and on Ethernet: in by a channel, and out by it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Protocol

from eap.appliance.discards import Refusal
from eap.appliance.services.routing.mailbox_frames import (
    FrameTaker,
    MailboxCounters,
    aoe_packet,
    refusal_of,
)
from eap.pd.link import Channel, FrameOrigin, OutFrame


class WayIn(Protocol):
    """Where packets of a channel go."""

    def receive(self, data: bytes, connection: str, *, for_all: bool = False) -> None:
        """Act on a packet that came from the address *connection*."""


class MailboxIntake:
    """One channel's frames for the stations behind it.

    Args:
        entrance: To these stations.
        gateway: For what is no AoE to a station; a frame for many is for no gateway.
        carrier: Sends what the gateway answers.
        is_for_many: Tells of a frame whether it was meant for many.
        is_aoe_here: Whether AoE is for the stations; otherwise that is for the gateway too.
    """

    def __init__(
        self,
        entrance: WayIn,
        gateway: FrameTaker,
        carrier: ChannelCarrier,
        is_for_many: Callable[[memoryview], bool],
        *,
        is_aoe_here: bool = True,
    ) -> None:
        self._entrance = entrance
        self._gateway = gateway
        self._carrier = carrier
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
            self._entrance.receive(packet, sender, for_all=is_for_many)
            return None
        if is_for_many:
            return refusal_of(frame)
        return self._gateway.receive(bytes(frame), sender, self._carrier.send_frame)

    def judge(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> Refusal | None:
        """Return why a frame is not taken that this intake gets too, without acting on it."""
        del at_ns, origin
        if aoe_packet(data[:size]) is not None:
            return None
        reason = refusal_of(data[:size])
        is_taken = self._gateway.is_there and not self._is_for_many(data)
        return None if is_taken and reason is Refusal.MAILBOX else reason


class ChannelCarrier:
    """Sends packets in frames to addresses that *channel* reaches."""

    def __init__(self, channel: Channel) -> None:
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
