"""Frames of type 5 that come as datagrams or on Ethernet: each is answered where it came from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic_ns

from eap.appliance.discards import Refusal
from eap.appliance.services.aoe_desk import AoeDesk
from eap.appliance.services.mailbox_door import MailboxDoor, aoe_packet
from eap.pd.link import Channel, Origin, OutFrame


class MailboxIntake:
    """One channel's frames for the stations behind it.

    Args:
        desks: Of these stations.
        channel: Sends answers.
        largest: Octets of the largest frame that goes through it.
        for_many: Tells of a frame whether it was meant for many.
    """

    def __init__(
        self,
        desks: Sequence[AoeDesk],
        channel: Channel,
        largest: int,
        for_many: Callable[[memoryview], bool],
    ) -> None:
        self._door = MailboxDoor(desks, largest)
        self._channel = channel
        self._for_many = for_many

    def take(self, data: memoryview, size: int, at_ns: int, origin: Origin) -> Refusal | None:
        """Act on a frame; return why not if it is not taken."""
        sender = origin.sender_of(data)
        if not sender:
            return Refusal.MAILBOX
        send = partial(self._send, sender)
        for_many = self._for_many(data)
        return self._door.receive_frame(data[:size], send, at_ns, for_all=for_many)

    def _send(self, destination: str, frame: bytes) -> None:
        header = self._channel.link_header(destination)
        buffer = bytearray(header + frame)
        buffer += bytes(max(0, self._channel.minimum_size - len(buffer)))
        self._channel.send([OutFrame(buffer, len(header), destination)], monotonic_ns())


def judge(data: memoryview, size: int, at_ns: int, origin: Origin) -> Refusal | None:
    """Leave a frame to another intake that gets it too; return why that does not take it."""
    del at_ns, origin
    packet = aoe_packet(data[:size])
    return packet if isinstance(packet, Refusal) else None
