"""Frames of type 5, and messages as they lie in a slave's mailbox."""

from __future__ import annotations

from contextlib import suppress

from eap.codec.mailbox import decode_frame, decode_message, encode_message
from eap.errors import CodecError


def fuzz_one(data: bytes) -> None:
    """Read frame and message, write the message again; only CodecError may pass."""
    try:
        header, body = decode_message(data)
    except CodecError:
        pass
    else:
        if not data.startswith(encode_message(header, body)):
            raise AssertionError("the message encodes to other octets")
    with suppress(CodecError):
        decode_frame(data)
