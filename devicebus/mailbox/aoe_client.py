"""AoE as a conversation: an AMS packet to a slave and its answer, also in fragments (ETG.1020).

Fragments of a request are not acknowledged: a full mailbox delays the next fragment.  Fragments of
an answer are acknowledged if the slave requests it.
"""

from __future__ import annotations

from msgspec.structs import replace

from devicebus.errors import MailboxProtocolError, MailboxSizeError
from devicebus.mailbox.conversation import (
    RESPONSE_TIMEOUT_NS,
    Conversation,
    MailboxRequest,
    answers,
    is_aoe_fragment,
    reading,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.ams.reassembly import FragmentAssembler, iter_fragments
from eap.codec.ams import AmsHeader, decode_packet, encode_packet
from eap.codec.mailbox import MailboxHeader, MailboxType

# Limit for dropped fragments of other answers before a request fails.
_MAX_LATE = 16


def exchange(
    header: AmsHeader,
    data: bytes,
    sizes: MailboxSizes,
    *,
    timeout_ns: int = RESPONSE_TIMEOUT_NS,
) -> Conversation[tuple[AmsHeader, bytes]]:
    """Send a request and return header and data of the answer.

    The answer has the invoke id and command of the request; its source is the request's target.

    Raises:
        MailboxProtocolError: the reply is no valid answer.
        MailboxSizeError: the mailbox is too small for fragments.
    """
    what = f"AoE answer of {header.target}:{header.target_port}"
    packet = encode_packet(header, data)
    if len(packet) <= sizes.to_slave - MailboxHeader.SIZE:
        request = MailboxRequest(MailboxType.AOE, packet, timeout_ns=timeout_ns)
    else:
        yield from _send_fragments(packet, header.invoke_id, sizes)
        request = MailboxRequest(
            MailboxType.AOE, packet[: AmsHeader.SIZE], listen=True, timeout_ns=timeout_ns
        )
    whole = (yield request).data
    if is_aoe_fragment(whole):
        whole = yield from _reassemble(what, whole, replace(request, listen=True))
    with reading(what):
        answer, body = decode_packet(whole)
    return answer, bytes(body)


def send(header: AmsHeader, data: bytes, sizes: MailboxSizes) -> Conversation[None]:
    """Send a request without an answer; raises MailboxSizeError as exchange() does."""
    packet = encode_packet(header, data)
    if len(packet) <= sizes.to_slave - MailboxHeader.SIZE:
        yield MailboxRequest(MailboxType.AOE, packet, expects_reply=False)
    else:
        yield from _send_fragments(packet, header.invoke_id, sizes)


def _send_fragments(packet: bytes, number: int, sizes: MailboxSizes) -> Conversation[None]:
    # The smaller mailbox limits a fragment, as slave stacks expect it in both directions.
    fragment_size = min(sizes.to_slave, sizes.to_master) - MailboxHeader.SIZE - AmsHeader.SIZE
    if fragment_size < 1:
        raise MailboxSizeError(
            f"AoE request of {len(packet)} bytes: a mailbox of {sizes.to_slave} bytes holds no"
            " fragment of it"
        )
    for fragment in iter_fragments(packet, number, fragment_size):
        yield MailboxRequest(MailboxType.AOE, fragment, expects_reply=False)


def _reassemble(what: str, first: bytes, more: MailboxRequest) -> Conversation[bytes]:
    """Reassemble the answer that begins with *first*; *more* listens for its other fragments."""
    assembler = FragmentAssembler()
    message = first
    is_begun = False
    late = 0
    while late < _MAX_LATE:
        with reading(what):
            header, body = decode_packet(message)
        request = more
        # The low word of a fragment's invoke id is its number, the high word that of the packet.
        if not is_begun and header.invoke_id & 0xFFFF:
            late += 1  # the rest of an answer whose request has ended
        else:
            is_begun = True
            with reading(what):
                # Time 0: the conversation's time-out is the limit, not that of the assembler.
                packet, acknowledgement = assembler.receive(header, bytes(body), 0)
            if packet is not None:
                if answers(more.type, more.request, packet):
                    return packet
                is_begun = False
                late += 1
            elif acknowledgement is not None:
                request = replace(more, request=acknowledgement, listen=False)
        message = (yield request).data
        if not is_aoe_fragment(message):
            return message
    raise MailboxProtocolError(f"{what}: {late} fragments of other answers")
