"""AoE on the side of a slave: AMS packets handed to whoever answers them (ETG.1020)."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.protocol import refuse
from eap.codec.ams import AmsHeader, StateFlags, decode_packet, encode_packet
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError


class AoeServer:
    """The AoE protocol of a slave.

    Args:
        handler: Called with header and data of each request; returns the data of the answer, None
            if there is none.
    """

    def __init__(self, handler: Callable[[AmsHeader, bytes], bytes | None]) -> None:
        self._handler = handler

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a packet behind its mailbox header and return the answer, if it has one."""
        del now_ns
        try:
            header, body = decode_packet(data)
        except CodecError as exc:
            refuse(MailboxError.SIZE_TOO_SHORT, str(exc))
        if header.state_flags & StateFlags.RESPONSE:
            refuse(MailboxError.SERVICE_NOT_SUPPORTED, "a response, but nothing was asked")
        answer = self._handler(header, bytes(body))
        if answer is None or header.state_flags & StateFlags.NO_RETURN:
            return []
        back = AmsHeader(
            header.source,
            header.source_port,
            header.target,
            header.target_port,
            header.command,
            header.state_flags | StateFlags.RESPONSE,
            invoke_id=header.invoke_id,
        )
        return [encode_packet(back, answer)]

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return nothing: this server only answers."""
        del now_ns
        return []

    def reset(self) -> None:
        """Do nothing: this server remembers nothing."""
