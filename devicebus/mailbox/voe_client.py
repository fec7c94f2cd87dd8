"""VoE as a conversation: one request of a vendor's protocol and its answer (ETG.1000.6)."""

from __future__ import annotations

from devicebus.mailbox.conversation import RESPONSE_TIMEOUT_NS, Conversation, MailboxRequest
from eap.codec.mailbox import MailboxType
from eap.codec.voe import VoeHeader


def exchange(
    vendor_id: int, vendor_type: int, data: bytes, *, timeout_ns: int = RESPONSE_TIMEOUT_NS
) -> Conversation[bytes]:
    """Send data to a slave; return the data of its answer of the same vendor and type."""
    head = VoeHeader(vendor_id, vendor_type).encode()
    message = yield MailboxRequest(MailboxType.VOE, head + data, timeout_ns=timeout_ns)
    return message.data[VoeHeader.SIZE :]


def send(vendor_id: int, vendor_type: int, data: bytes) -> Conversation[None]:
    """Send data to a slave that does not answer."""
    head = VoeHeader(vendor_id, vendor_type).encode()
    yield MailboxRequest(MailboxType.VOE, head + data, expects_reply=False)
