"""Requests of the high-nibble dialect, and the answers to what they ask for."""

from __future__ import annotations

from itertools import cycle

from eap.codec.mailbox import MailboxHeader, MailboxType, decode_message, encode_message
from eap.errors import MalformedError
from eap.gateway import dialect
from eap.gateway.dialect import DialectFailure
from tools.fuzz.messages import cut

_KINDS = (MailboxType.COE, MailboxType.SOE, MailboxType.FOE, MailboxType.VOE)


def fuzz_one(data: bytes) -> None:
    """Decode a request; every request has an answer with its protocol in the header."""
    for kind, body in zip(cycle(_KINDS), cut(data), strict=False):
        try:
            task = dialect.decode(kind, body)
        except MalformedError:
            answer = dialect.encode_failure(kind, body, DialectFailure.COMMAND, text="malformed")
        else:
            answer = dialect.encode_done(body, task, data[:40])
        message = encode_message(dialect.encode_header(kind, 1001), answer)
        header, back = decode_message(message)
        if dialect.kind_of(header) is not kind or bytes(back) != answer:
            raise AssertionError(f"an answer of {kind.name} that is none: {message.hex()}")
        dialect.kind_of(MailboxHeader(0, 0, type=kind, counter=len(body) % 8))
