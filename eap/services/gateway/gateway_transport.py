"""Binding of a socket to a gateway, for frames of type 5 that are no AoE to a station itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from eap.codec.mailbox import MailboxError, encode_plain_frame
from eap.errors import MalformedError, TruncatedError
from eap.gateway.requests import mailbox_error
from eap.ids import Endpoint, endpoint_of
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName
from eap.services.transports.mailbox_frames import refusal_of

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway

_ADDRESS = slice(4, 6)


class GatewayTable:
    """Gateways of the appliance, which come and go with their buses.

    Attributes:
        by_port: By bus port, in the order of the ports.
        by_station: The first of each station.
    """

    def __init__(self) -> None:
        self.by_port: dict[PortName, MailboxGateway] = {}
        self.by_station: dict[str, MailboxGateway] = {}

    def replace(self, gateways: Mapping[PortName, MailboxGateway]) -> None:
        """Have these *gateways* from now on."""
        self.by_port = dict(gateways)
        self.by_station = {}
        for owner, gateway in gateways.items():
            self.by_station.setdefault(owner.station, gateway)


class GatewayTransport:
    """One socket or listener, and the gateway behind it.

    Args:
        gateways: All of the appliance.
        names: Name of the transport at each station there; a frame does not name its station, so
            the first one with a gateway handles it.
        owner: Bus port that has the socket to itself; None for the first bus of a station.
    """

    def __init__(
        self, gateways: GatewayTable, names: Mapping[str, str], owner: PortName | None = None
    ) -> None:
        self._gateways = gateways
        self._names = names
        self._owner = owner

    def _find(self) -> tuple[MailboxGateway | None, str]:
        """Return the gateway behind the socket now, and the name of the transport there."""
        # A mailbox address names no bus: several gateways need sockets of their own.
        if self._owner is not None:
            gateway = self._gateways.by_port.get(self._owner)
            return gateway, self._names[self._owner.station]
        for station, name in self._names.items():
            if (gateway := self._gateways.by_station.get(station)) is not None:
                return gateway, name
        return None, ""

    @property
    def has_gateway(self) -> bool:
        """True if there is any gateway behind."""
        return self._find()[0] is not None

    def receive(
        self, frame: bytes, connection: str, send: Callable[[str, bytes], object]
    ) -> DropReason | None:
        """Act on a frame; return why not if it is not taken.

        Args:
            frame: From its EtherCAT header on.
            connection: That it came by, or its sender's address.
            send: Sends a frame to *connection*.
        """
        gateway, name = self._find()
        if gateway is None:
            return refusal_of(frame)
        if not gateway.is_open:
            gateway.dropped += 1
            return DropReason.GATEWAY_OFF

        def answer(frame: bytes) -> None:
            send(connection, frame)

        try:
            gateway.receive(frame, endpoint_of(name, connection), answer)
        except TruncatedError:
            return DropReason.TRUNCATED
        except MalformedError:
            if not gateway.settings.is_silent:
                _reply_unknown_type(frame, answer)
            return DropReason.MAILBOX
        return None

    def connection_closed(self, connection: str) -> None:
        """Forget a client whose connection is closed."""
        gateway, name = self._find()
        if gateway is not None:
            gateway.connection_closed(Endpoint(name, connection))

    def waiting(self, connection: str) -> int:
        """Return how many requests of a connection wait for their answers."""
        gateway, name = self._find()
        return 0 if gateway is None else gateway.tracker.waiting(Endpoint(name, connection))

    async def wait_below(self, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection wait."""
        gateway, name = self._find()
        if gateway is not None:
            await gateway.wait_below(Endpoint(name, connection), count)


def _reply_unknown_type(frame: bytes, answer: Callable[[bytes], None]) -> None:
    """Reply that the protocol of a frame is not supported."""
    kind, body = mailbox_error(MailboxError.UNSUPPORTED_PROTOCOL)
    address = int.from_bytes(frame[_ADDRESS], "little")
    answer(encode_plain_frame(kind, address, 0, body))
