"""Demultiplexer: the station of a packet, where several share a socket or a listener."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic_ns

from eap.ams.reassembly import Reassembly
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.errors import CodecError
from eap.ids import Endpoint, NetId
from eap.services.routing.station_router import StationRouter


class Demultiplexer:
    """Distributes the packets of one socket among its stations.

    A packet goes to the station with its target NetID, or with a pending request that it answers;
    any other request to the station with the best route.  The first station gets what is left.

    Args:
        behind: The stations, each with its name of the transport; :meth:`follow` changes them.
    """

    def __init__(self, behind: Sequence[tuple[StationRouter, str]]) -> None:
        self._behind = behind
        self._fragments = Reassembly()

    def follow(self, behind: Sequence[tuple[StationRouter, str]]) -> None:
        """Distribute packets among other stations from now on."""
        self._behind = behind

    def receive(self, data: bytes, connection: str, *, is_broadcast: bool = False) -> None:
        """Act on a packet; the arguments are those of :meth:`StationRouter.receive`."""
        if len(self._behind) <= 1 or is_broadcast:
            for station, transport in self._behind:
                station.receive(data, transport, connection, is_broadcast=is_broadcast)
            return
        try:
            whole = self._whole(data, connection)
            if whole is None:
                return
            header, body = decode_packet(whole)
            station, transport = self._find(header, bytes(body))
        except CodecError:
            whole = data
            station, transport = self._behind[0]  # its record shows the packet
        station.receive(whole, transport, connection)

    def connection_closed(self, connection: str) -> None:
        """Notify the stations that a connection has ended."""
        for station, transport in self._behind:
            self._fragments.forget(Endpoint(transport, connection))
            station.connection_closed(transport, connection)

    def has(self, net_id: NetId) -> bool:
        """Return whether a NetID belongs to one of the stations."""
        return any(net_id in station.net_ids for station, _ in self._behind)

    def set_hop_connection(self, address: str, connection: str) -> None:
        """Treat packets from *connection* as packets from the hop *address*, at all stations."""
        for station, transport in self._behind:
            station.set_hop_connection(transport, address, connection)

    def hop_down(self, address: str, text: str) -> None:
        """Mark the hop *address* as down at all stations; *text* is the reason."""
        for station, transport in self._behind:
            station.hop_down(transport, address, text)

    def hop_up(self, address: str) -> None:
        """Mark the hop *address* as up at all stations."""
        for station, transport in self._behind:
            station.hop_up(transport, address)

    def has_route_to(self, address: str) -> bool:
        """Return whether a route of a station leads to *address*."""
        return any(
            station.has_route_to(Endpoint(transport, address))
            for station, transport in self._behind
        )

    def is_awaited(self, address: str) -> bool:
        """Return whether a station waits for an answer from *address*."""
        return any(
            station.is_awaited(Endpoint(transport, address)) for station, transport in self._behind
        )

    def waiting(self, connection: str) -> int:
        """Return the number of pending requests of a connection."""
        return sum(
            station.waiting(Endpoint(transport, connection)) for station, transport in self._behind
        )

    async def wait_below(self, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection are pending at each station."""
        for station, transport in self._behind:
            await station.wait_below(transport, connection, count)

    def _whole(self, data: bytes, connection: str) -> bytes | None:
        """Return the packet that *data* is or completes; None if fragments are missing.

        Raises:
            CodecError: *data* is no packet, or a fragment without those before it.
        """
        header, body = decode_packet(data)
        if header.command != AmsCommand.FRAGMENT:
            return data
        # Own fragments want no acknowledgement.
        if header.state_flags & StateFlags.RESPONSE:
            return None
        station, transport = self._behind[0]
        endpoint = Endpoint(transport, connection)
        packet, acknowledgement = self._fragments.receive(
            endpoint, header, bytes(body), monotonic_ns()
        )
        # The target is only known from the whole packet: any station may acknowledge its fragments.
        if acknowledgement is not None:
            station.send_notification(endpoint, acknowledgement)
        return packet

    def _find(self, header: AmsHeader, body: bytes) -> tuple[StationRouter, str]:
        # Pending requests first: a forwarded answer has the NetID of its client as target.
        for station, transport in self._behind:
            if station.is_waiting_for(header, body, transport):
                return station, transport
        for station, transport in self._behind:
            if header.target in station.net_ids:
                return station, transport
        return max(self._behind, key=lambda each: _match(each[0], header))


def _match(station: StationRouter, header: AmsHeader) -> int:
    """Return how many octets of the target match a route of *station*; -1 if there is none."""
    found = station.table.find(header.target)
    return -1 if found is None else found[1]
