"""What a service answers, and the packet that brings it back."""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.ams import AmsHeader, StateFlags

_RESPONSE = StateFlags.RESPONSE.value  # a plain number: operators of flags are slow


class AmsAnswer(NamedTuple):
    """What goes back to the sender of a request."""

    data: bytes = b""
    error_code: int = 0
    """Of the AMS header: why the request reached nobody."""
    why: str = ""
    """For people, where results inside *data* refuse something: what, and why."""


def response_to(header: AmsHeader, answer: AmsAnswer) -> bytes:
    """Return the packet that brings *answer* back to who sent the request with *header*."""
    data = answer.data
    back = AmsHeader(
        header.source,
        header.source_port,
        header.target,
        header.target_port,
        header.command,
        header.state_flags | _RESPONSE,
        len(data),
        answer.error_code,
        header.invoke_id,
    )
    return back.encode() + data
