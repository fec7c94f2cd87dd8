"""Frames of type 5 at a socket or a connection: what is for this station goes to its desks.

That is AoE to address 0; every other mailbox belongs to a bus, and nothing in this release passes
it on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from devicebus.mailbox.counter import next_counter
from eap.appliance.discards import Refusal
from eap.appliance.services.aoe_desk import AoeDesk, AoeDoor
from eap.codec.ethercat import EtherCatHeader
from eap.codec.mailbox import MailboxHeader, MailboxType, decode_frame, encode_frame
from eap.codec.wire import Buffer
from eap.errors import CodecError

FRAME_OVERHEAD = EtherCatHeader.SIZE + MailboxHeader.SIZE


def aoe_packet(data: Buffer) -> bytes | Refusal:
    """Return the AMS packet in a frame of type 5, or why there is none for a station."""
    try:
        header, body = decode_frame(data)
    except CodecError:
        return Refusal.TRUNCATED
    if header.type is not MailboxType.AOE or header.address:
        return Refusal.MAILBOX
    return bytes(body)


class MailboxDoor:
    """Where frames come in.

    Args:
        desks: Of the stations behind it.
        largest: Octets of the largest frame that goes back.
    """

    def __init__(self, desks: Sequence[AoeDesk], largest: int) -> None:
        self._aoe = AoeDoor(desks, largest - FRAME_OVERHEAD)
        self._counter = 0

    def receive_frame(
        self, data: Buffer, send: Callable[[bytes], None], now_ns: int, *, for_all: bool = False
    ) -> Refusal | None:
        """Act on a frame of type 5; return why not if it is not taken.

        Args:
            data: The frame from its EtherCAT header on.
            send: Sends a frame back to who sent this one, now or later.
            now_ns: The time on the monotonic clock.
            for_all: Whether it came by multicast.
        """
        body = aoe_packet(data)
        if isinstance(body, Refusal):
            return body

        def reply(packet: bytes) -> None:
            # Requests are told apart by who asks and by their numbers, so what repeats a counter
            # is not dropped here: clients of their own making often leave it at 1.
            self._counter = next_counter(self._counter)
            back = MailboxHeader(0, 0, type=MailboxType.AOE, counter=self._counter)
            send(encode_frame(back, packet))

        if self._aoe.receive_packet(body, reply, now_ns, for_all=for_all):
            return None
        return Refusal.MAILBOX
