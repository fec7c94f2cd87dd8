"""Endpoints of AMS clients and hops, and the answers that go back to them."""

from __future__ import annotations

from typing import NamedTuple

from eap.codec.ams import AmsHeader, StateFlags


class Endpoint(NamedTuple):
    """Connection of a transport, or an address on a transport without connections.

    Two connections never have the same name while a process runs, even from one address; where
    there are none, *connection* is the sender's address, which answers go back to.
    """

    transport: str
    connection: str

    @property
    def kind(self) -> str:
        """Kind of the transport, a :class:`~eap.ams.spec.TransportKind`."""
        return self.transport.partition(":")[0]

    def __str__(self) -> str:
        # A transport to a single address is named after it: print the address once.
        return f"{self.connection} by {self.transport.removesuffix(f':{self.connection}')}"


_RESPONSE = StateFlags.RESPONSE.value  # a plain number: operators of flags are slow


class AmsAnswer(NamedTuple):
    """Answer of a service to a request."""

    data: bytes = b""
    error_code: int = 0
    """Of the AMS header: the reason the request was not delivered."""
    why: str = ""
    """Reason for operators, where results inside *data* refuse something."""


def response_to(header: AmsHeader, answer: AmsAnswer) -> bytes:
    """Return the packet with *answer* to the request with *header*."""
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
