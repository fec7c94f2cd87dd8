"""AoE as a conversation: an AMS packet to a slave and its answer (ETG.1020)."""

from __future__ import annotations

from devicebus.mailbox.conversation import RESPONSE_TIMEOUT_NS, Ask, Conversation, reading
from eap.codec.ams import AmsHeader, decode_packet, encode_packet
from eap.codec.mailbox import MailboxType


def exchange(
    header: AmsHeader, data: bytes, *, timeout_ns: int = RESPONSE_TIMEOUT_NS
) -> Conversation[tuple[AmsHeader, bytes]]:
    """Send a request; return header and data of the answer.

    The answer has the invoke id and the command of the request, and comes from where that went.
    """
    packet = encode_packet(header, data)
    message = yield Ask(MailboxType.AOE, packet, timeout_ns=timeout_ns)
    with reading(f"AoE answer of {header.target}:{header.target_port}"):
        answer, body = decode_packet(message.data)
    return answer, bytes(body)
