"""AoE on the side of a slave: AMS packets handed to whoever answers them (ETG.1020).

What is longer than the mailbox comes and goes in fragments.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.protocol import MailboxSizes, refuse
from eap.ads.answer import AmsAnswer, response_to
from eap.ams.fragment import Assembler, iter_fragments
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError


class AoeServer:
    """The AoE protocol of a slave.

    Args:
        handler: Called with header and data of each request; returns None if it has no answer.
        sizes: Of the slave's mailboxes.
        forget: Called when the mailbox starts again.
    """

    def __init__(
        self,
        handler: Callable[[AmsHeader, bytes], AmsAnswer | None],
        sizes: MailboxSizes,
        *,
        forget: Callable[[], None] | None = None,
    ) -> None:
        self.assembler = Assembler()
        self._forget = forget
        self._handler = handler
        self._sizes = sizes
        self._number = 0

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a packet behind its mailbox header and return the answer, if it has one."""
        try:
            header, body = decode_packet(data)
        except CodecError as exc:
            refuse(MailboxError.SIZE_TOO_SHORT, str(exc))
        if header.state_flags & StateFlags.RESPONSE:
            refuse(MailboxError.SERVICE_NOT_SUPPORTED, "a response, but nothing was asked")
        if header.command != AmsCommand.FRAGMENT:
            return self._answer(header, bytes(body))
        try:
            packet, acknowledgement = self.assembler.receive(header, bytes(body), now_ns)
        except CodecError as exc:
            refuse(MailboxError.INVALID_SIZE, str(exc))
        if packet is None:
            return [] if acknowledgement is None else [acknowledgement]
        header, body = decode_packet(packet)
        return self._answer(header, bytes(body))

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return nothing: this server only answers."""
        del now_ns
        return []

    def reset(self) -> None:
        """Forget the packets that are not complete, and what the handler remembers."""
        self.assembler.reset()
        if self._forget is not None:
            self._forget()

    def _answer(self, header: AmsHeader, body: bytes) -> list[bytes]:
        answer = self._handler(header, body)
        if answer is None or header.state_flags & StateFlags.NO_RETURN:
            return []
        packet = response_to(header, answer)
        room = self._sizes.data_to_master - AmsHeader.SIZE
        if len(packet) <= self._sizes.data_to_master or room < 1:
            return [packet]
        self._number += 1
        return list(iter_fragments(packet, self._number, room))
