"""Endpoint of an AMS client or hop: the transport, and the connection or address behind it."""

from __future__ import annotations

from typing import NamedTuple


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
