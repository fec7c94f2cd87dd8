"""What a service answers, and the packet that brings it back."""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.ams import AmsHeader, StateFlags, encode_packet


class AmsAnswer(NamedTuple):
    """What goes back to the sender of a request."""

    data: bytes = b""
    error_code: int = 0
    """Of the AMS header: why the request reached nobody."""
    why: str = ""
    """For people, where results inside *data* refuse something: what, and why."""


def response_to(header: AmsHeader, answer: AmsAnswer) -> bytes:
    """Return the packet that brings *answer* back to who sent the request with *header*."""
    back = AmsHeader(
        header.source,
        header.source_port,
        header.target,
        header.target_port,
        header.command,
        header.state_flags | StateFlags.RESPONSE,
        error_code=answer.error_code,
        invoke_id=header.invoke_id,
    )
    return encode_packet(back, answer.data)
