"""AoE as a conversation: an AMS packet to a slave and its answer, also in fragments (ETG.1020).

The fragments of a request are not acknowledged: a mailbox that is still full holds the next one
back.  Those of an answer are, if the slave wants it.
"""

from __future__ import annotations

from msgspec.structs import replace

from devicebus.errors import MailboxProtocolError, MailboxSizeError
from devicebus.mailbox.conversation import (
    RESPONSE_TIMEOUT_NS,
    Conversation,
    MailboxRequest,
    reading,
)
from devicebus.mailbox.match import answers, is_aoe_fragment
from devicebus.mailbox.protocol import MailboxSizes
from eap.ams.reassembly import Assembler, iter_fragments
from eap.codec.ams import AmsHeader, decode_packet, encode_packet
from eap.codec.mailbox import MailboxHeader, MailboxType

_MAX_LATE = 16
"""Fragments of other answers that are dropped before a request gives up."""


def exchange(
    header: AmsHeader,
    data: bytes,
    sizes: MailboxSizes,
    *,
    timeout_ns: int = RESPONSE_TIMEOUT_NS,
) -> Conversation[tuple[AmsHeader, bytes]]:
    """Send a request; return header and data of the answer.

    The answer has the invoke id and the command of the request, and comes from where that went.

    Raises:
        MailboxProtocolError: what came is no answer.
        MailboxSizeError: the mailbox does not even hold fragments.
    """
    what = f"AoE answer of {header.target}:{header.target_port}"
    packet = encode_packet(header, data)
    if len(packet) <= sizes.to_slave - MailboxHeader.SIZE:
        ask = MailboxRequest(MailboxType.AOE, packet, timeout_ns=timeout_ns)
    else:
        yield from _send_fragments(packet, header.invoke_id, sizes)
        ask = MailboxRequest(
            MailboxType.AOE, packet[: AmsHeader.SIZE], listen=True, timeout_ns=timeout_ns
        )
    whole = (yield ask).data
    if is_aoe_fragment(whole):
        whole = yield from _gather(what, whole, replace(ask, listen=True))
    with reading(what):
        answer, body = decode_packet(whole)
    return answer, bytes(body)


def send(header: AmsHeader, data: bytes, sizes: MailboxSizes) -> Conversation[None]:
    """Send a request that wants no answer; raises MailboxSizeError as exchange() does."""
    packet = encode_packet(header, data)
    if len(packet) <= sizes.to_slave - MailboxHeader.SIZE:
        yield MailboxRequest(MailboxType.AOE, packet, expects_reply=False)
    else:
        yield from _send_fragments(packet, header.invoke_id, sizes)


def _send_fragments(packet: bytes, number: int, sizes: MailboxSizes) -> Conversation[None]:
    room = min(sizes.to_slave, sizes.to_master) - MailboxHeader.SIZE - AmsHeader.SIZE
    if room < 1:
        raise MailboxSizeError(
            f"AoE request of {len(packet)} bytes: a mailbox of {sizes.to_slave} bytes holds no"
            " fragment of it"
        )
    for fragment in iter_fragments(packet, number, room):
        yield MailboxRequest(MailboxType.AOE, fragment, expects_reply=False)


def _gather(what: str, first: bytes, more: MailboxRequest) -> Conversation[bytes]:
    """Put the answer together that begins with *first*; *more* listens for what follows."""
    assembler = Assembler()
    message = first
    is_begun = False
    late = 0
    while late < _MAX_LATE:
        with reading(what):
            header, body = decode_packet(message)
        ask = more
        if not is_begun and header.invoke_id & 0xFFFF:
            late += 1  # the rest of an answer that nobody waits for any more
        else:
            is_begun = True
            with reading(what):
                packet, acknowledgement = assembler.receive(header, bytes(body), 0)
            if packet is not None:
                if answers(more.type, more.request, packet):
                    return packet
                is_begun = False
                late += 1
            elif acknowledgement is not None:
                ask = replace(more, request=acknowledgement, listen=False)
        message = (yield ask).data
        if not is_aoe_fragment(message):
            return message
    raise MailboxProtocolError(f"{what}: {late} fragments of other answers")
