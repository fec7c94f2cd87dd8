"""Actions of a router, and the transports by which its packets leave, whole or in fragments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias

import msgspec

from eap.ams.reassembly import iter_fragments
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint


class Forward(msgspec.Struct, frozen=True, gc=False):
    """A request for the next hop.

    Attributes:
        hop: Where it goes.
        packets: One, or its fragments in their order.
        ticket: Names the request, for a transport that cannot send it.
    """

    hop: Endpoint
    packets: tuple[bytes, ...]
    ticket: int


class Reply(msgspec.Struct, frozen=True, gc=False):
    """An answer or a notification, for the connection that it belongs to.

    Attributes:
        endpoint: The connection.
        packets: One, or its fragments in their order.
    """

    endpoint: Endpoint
    packets: tuple[bytes, ...]


class Deliver(msgspec.Struct, frozen=True, gc=False):
    """A request for a service of this station.

    Attributes:
        ticket: Names the request, for its answer.
        header: As it came.
        body: What follows the header.
        endpoint: Endpoint of the client; its notifications go there too.
    """

    ticket: int
    header: AmsHeader
    body: bytes
    endpoint: Endpoint


Action: TypeAlias = Forward | Reply | Deliver


class Transport(msgspec.Struct, frozen=True):
    """Transport as the router sees it.

    Attributes:
        name: As in the plant file.
        max_size: Bytes of the longest packet in one piece, header included; 0 for any. A longer
            packet goes in fragments.
        is_stream: Whether packets never arrive twice; on others a repeated request is dropped.
        is_shared: Whether all answers arrive by one connection, from any peer (a broker).
        is_hub: Whether those behind it reach each other through a router only, so that packets
            may go back to where they came in, though not to the same address.
    """

    name: str
    max_size: int = 0
    is_stream: bool = False
    is_shared: bool = False
    is_hub: bool = False


class TransportTable:
    """Transports of a router; raises as :meth:`add`."""

    def __init__(self, transports: Iterable[Transport]) -> None:
        self._transports: dict[str, Transport] = {}
        self._number = 0
        self._connections: dict[Endpoint, str] = {}
        for transport in transports:
            self.add(transport)

    def add(self, transport: Transport) -> None:
        """Add a transport.

        Raises:
            ValueError: it cannot carry a fragment, or has the name of another.
        """
        if transport.name in self._transports:
            raise ValueError(f"transport {transport.name!r} exists already")
        if transport.max_size and transport.max_size <= AmsHeader.SIZE:
            raise ValueError(
                f"transport {transport.name!r}: {transport.max_size} bytes,"
                f" expected more than {AmsHeader.SIZE}"
            )
        self._transports[transport.name] = transport

    def remove(self, name: str) -> None:
        """Remove a transport; nothing is sent by it any more."""
        del self._transports[name]

    @property
    def transports(self) -> Mapping[str, Transport]:
        """All transports by name."""
        return self._transports

    def set_connection(self, hop: Endpoint, connection: str) -> None:
        """Note that packets of *hop*, which is a name, arrive by *connection*."""
        self._connections[hop] = connection

    def is_from(self, hop: Endpoint, endpoint: Endpoint) -> bool:
        """Return whether packets from *endpoint* may come from *hop*."""
        if hop == endpoint:
            return True
        if hop.transport != endpoint.transport:
            return False
        return (
            self._transports[endpoint.transport].is_shared
            or self._connections.get(hop) == endpoint.connection
        )

    def reply(self, endpoint: Endpoint, packet: bytes) -> Reply:
        """Return the action that sends *packet* back to *endpoint*."""
        max_size = self._transports[endpoint.transport].max_size
        is_whole = not max_size or len(packet) <= max_size
        return Reply(endpoint, (packet,) if is_whole else self._split(packet, max_size))

    def forward(self, hop: Endpoint, packet: bytes, ticket: int) -> Forward:
        """Return the action that sends *packet* to *hop*."""
        max_size = self._transports[hop.transport].max_size
        is_whole = not max_size or len(packet) <= max_size
        return Forward(hop, (packet,) if is_whole else self._split(packet, max_size), ticket)

    def _split(self, packet: bytes, max_size: int) -> tuple[bytes, ...]:
        self._number += 1
        return tuple(iter_fragments(packet, self._number, max_size - AmsHeader.SIZE))
