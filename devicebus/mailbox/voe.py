"""VoE for both sides: messages after a vendor's header (ETG.1000.6)."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.conversation import RESPONSE_TIMEOUT_NS, Conversation, MailboxRequest
from devicebus.mailbox.protocol import decode_or_error
from eap.codec.mailbox import MailboxType, VoeHeader


def exchange(
    vendor_id: int, vendor_type: int, data: bytes, *, timeout_ns: int = RESPONSE_TIMEOUT_NS
) -> Conversation[bytes]:
    """Send data to a slave; return the data of the answer with the same vendor and type."""
    head = VoeHeader(vendor_id, vendor_type).encode()
    message = yield MailboxRequest(MailboxType.VOE, head + data, timeout_ns=timeout_ns)
    return message.data[VoeHeader.SIZE :]


def send(vendor_id: int, vendor_type: int, data: bytes) -> Conversation[None]:
    """Send data to a slave without waiting for an answer."""
    head = VoeHeader(vendor_id, vendor_type).encode()
    yield MailboxRequest(MailboxType.VOE, head + data, expects_reply=False)


class VoeServer:
    """VoE protocol of a slave.

    Args:
        handler: Called with vendor id, vendor type and data of each request; returns the data of
            the answer, None if there is none.  Without it the slave echoes.
    """

    def __init__(self, handler: Callable[[int, int, bytes], bytes | None] | None = None) -> None:
        self._handler = handler

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a message (without mailbox header) and return its answers."""
        del now_ns
        header = decode_or_error(VoeHeader.decode, data)
        if self._handler is None:
            return [data]
        answer = self._handler(header.vendor_id, header.vendor_type, data[VoeHeader.SIZE :])
        return [] if answer is None else [header.encode() + answer]

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return nothing: this server only answers."""
        del now_ns
        return []

    def reset(self) -> None:
        """Do nothing: this server has no state."""
