"""Endpoints of AMS clients and hops, and the answers that go back to them."""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.ams import AmsHeader, StateFlags


class Endpoint(NamedTuple):
    """A connection, or an address that packets go to without one, of a door.

    Two connections never have the same name while a process runs, even from one address; where
    there are none, *connection* is the sender's address, which answers go back to.
    """

    transport: str
    connection: str

    @property
    def kind(self) -> str:
        """Kind of the door, a :class:`~eap.ams.spec.TransportKind`."""
        return self.transport.partition(":")[0]

    def __str__(self) -> str:
        # A door to one address only is named after it, which need not be said twice.
        return f"{self.connection} by {self.transport.removesuffix(f':{self.connection}')}"


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
