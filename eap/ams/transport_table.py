"""Actions of a router, and the transports by which its packets leave, whole or in fragments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, TypeAlias

import msgspec

from eap.ads.endpoint import Endpoint
from eap.ams.reassembly import iter_fragments
from eap.codec.ams import AmsHeader


class Forward(NamedTuple):
    """A request for the next hop."""

    hop: Endpoint
    packets: tuple[bytes, ...]
    """One, or its fragments in their order."""
    ticket: int
    """Names the request, for a door that cannot send it."""


class Reply(NamedTuple):
    """An answer or a notification, for the connection that it belongs to."""

    endpoint: Endpoint
    packets: tuple[bytes, ...]
    """One, or its fragments in their order."""


class Deliver(NamedTuple):
    """A request for a service of this station."""

    ticket: int
    """Names the request, for its answer."""
    header: AmsHeader
    body: bytes
    endpoint: Endpoint
    """Where notifications go, if it is about any."""


Action: TypeAlias = Forward | Reply | Deliver


class Transport(msgspec.Struct, frozen=True):
    """What a router has to know of one way to come in and go out.

    Attributes:
        name: As people call it.
        max_size: Bytes of the longest packet in one piece, header included; 0 for any. A longer
            packet goes in fragments.
        is_stream: Whether nothing comes twice; elsewhere what is asked again is not passed again.
        is_shared: Whether all answers come by one connection, whoever gives them (a broker).
        is_hub: Whether those behind it reach each other through a router only, so that packets
            may go back to where they came in, though not to the same address.
    """

    name: str
    max_size: int = 0
    is_stream: bool = False
    is_shared: bool = False
    is_hub: bool = False


class TransportTable:
    """The doors of a router, seen from inside; raises as :meth:`add`."""

    def __init__(self, transports: Iterable[Transport]) -> None:
        self._transports: dict[str, Transport] = {}
        self._number = 0
        self._connections: dict[Endpoint, str] = {}
        for transport in transports:
            self.add(transport)

    def add(self, transport: Transport) -> None:
        """Take one more door.

        Raises:
            ValueError: it has not even room for a fragment, or the name of another.
        """
        if transport.name in self._transports:
            raise ValueError(f"two doors {transport.name!r}")
        if transport.max_size and transport.max_size <= AmsHeader.SIZE:
            raise ValueError(
                f"transport {transport.name!r}: {transport.max_size} bytes,"
                f" expected more than {AmsHeader.SIZE}"
            )
        self._transports[transport.name] = transport

    def remove(self, name: str) -> None:
        """Forget a door; nothing goes back by it any more."""
        del self._transports[name]

    @property
    def transports(self) -> Mapping[str, Transport]:
        """All doors by name."""
        return self._transports

    def set_connection(self, hop: Endpoint, connection: str) -> None:
        """Know that what comes from *hop*, which has a name, comes by *connection*."""
        self._connections[hop] = connection

    def is_from(self, hop: Endpoint, endpoint: Endpoint) -> bool:
        """Say whether what comes by *endpoint* may come from *hop*."""
        if hop == endpoint:
            return True
        if hop.transport != endpoint.transport:
            return False
        return (
            self._transports[endpoint.transport].is_shared
            or self._connections.get(hop) == endpoint.connection
        )

    def reply(self, endpoint: Endpoint, packet: bytes) -> Reply:
        """Return how *packet* goes back by *endpoint*."""
        return Reply(endpoint, self._split(endpoint.transport, packet))

    def forward(self, hop: Endpoint, packet: bytes, ticket: int) -> Forward:
        """Return how *packet* goes on to *hop*."""
        return Forward(hop, self._split(hop.transport, packet), ticket)

    def _split(self, transport: str, packet: bytes) -> tuple[bytes, ...]:
        max_size = self._transports[transport].max_size
        if not max_size or len(packet) <= max_size:
            return (packet,)
        self._number += 1
        return tuple(iter_fragments(packet, self._number, max_size - AmsHeader.SIZE))
