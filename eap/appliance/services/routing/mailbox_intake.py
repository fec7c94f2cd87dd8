"""Frames of type 5 as datagrams and on Ethernet: in by a channel, and out by it."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic_ns
from typing import Protocol

from eap.appliance.discards import Refusal
from eap.appliance.services.routing.mailbox_frames import MailboxCounters, aoe_packet
from eap.pd.link import Channel, Origin, OutFrame


class WayIn(Protocol):
    """Where packets of a channel go."""

    def receive(self, data: bytes, connection: str, *, for_all: bool = False) -> None:
        """Act on a packet that came from the address *connection*."""


class MailboxIntake:
    """One channel's frames for the stations behind it.

    Args:
        entrance: To these stations.
        is_for_many: Tells of a frame whether it was meant for many.
    """

    def __init__(
        self,
        entrance: WayIn,
        is_for_many: Callable[[memoryview], bool],
    ) -> None:
        self._entrance = entrance
        self._is_for_many = is_for_many

    def take(self, data: memoryview, size: int, at_ns: int, origin: Origin) -> Refusal | None:
        """Act on a frame; return why not if it is not taken."""
        del at_ns
        sender = origin.sender_of(data)
        packet = aoe_packet(data[:size])
        if isinstance(packet, Refusal):
            return packet
        if not sender:
            return Refusal.MAILBOX
        self._entrance.receive(packet, sender, for_all=self._is_for_many(data))
        return None


def judge(data: memoryview, size: int, at_ns: int, origin: Origin) -> Refusal | None:
    """Leave a frame to another intake that gets it too; return why that does not take it."""
    del at_ns, origin
    packet = aoe_packet(data[:size])
    return packet if isinstance(packet, Refusal) else None


class ChannelCarrier:
    """Sends packets in frames to addresses that *channel* reaches."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._counters = MailboxCounters()

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to the address *connection*; return why not if that cannot be done."""
        header = self._channel.link_header(connection)
        frames = []
        for packet in packets:
            buffer = bytearray(header + self._counters.frame(connection, packet))
            buffer += bytes(max(0, self._channel.minimum_size - len(buffer)))
            frames.append(OutFrame(buffer, len(header), connection))
        failed = self._channel.send(frames, monotonic_ns())
        return "the network took no frame" if failed else None
