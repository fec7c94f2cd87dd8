"""Binding of a socket to a gateway, for frames of type 5 that are no AoE to a station itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from eap.codec.mailbox import MailboxError, encode_plain_frame
from eap.errors import MalformedError, TruncatedError
from eap.gateway.requests import mailbox_error
from eap.ids import Endpoint
from eap.runtime.drop_counters import DropReason
from eap.services.transports.mailbox_frames import refusal_of

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway

_ADDRESS = slice(4, 6)


class GatewayTransport:
    """One socket or listener, and the gateway behind it.

    Args:
        gateways: Gateways of the stations there, and the transport's name at each; a frame does
            not name its station, so the first gateway handles it.
    """

    def __init__(self, gateways: Sequence[tuple[MailboxGateway, str]]) -> None:
        self._gateway: MailboxGateway | None = None
        self._name = ""
        if gateways:
            # A mailbox address names no bus: several gateways need sockets of their own.
            self._gateway, self._name = gateways[0]

    @property
    def has_gateway(self) -> bool:
        """True if there is any gateway behind."""
        return self._gateway is not None

    def receive(
        self, frame: bytes, connection: str, send: Callable[[str, bytes], object]
    ) -> DropReason | None:
        """Act on a frame; return why not if it is not taken.

        Args:
            frame: From its EtherCAT header on.
            connection: That it came by, or its sender's address.
            send: Sends a frame to *connection*.
        """
        if self._gateway is None:
            return refusal_of(frame)
        if not self._gateway.is_open:
            self._gateway.dropped += 1
            return DropReason.GATEWAY_OFF

        def answer(frame: bytes) -> None:
            send(connection, frame)

        try:
            self._gateway.receive(frame, Endpoint(self._name, connection), answer)
        except TruncatedError:
            return DropReason.TRUNCATED
        except MalformedError:
            if not self._gateway.settings.is_silent:
                _reply_unknown_type(frame, answer)
            return DropReason.MAILBOX
        return None

    def connection_closed(self, connection: str) -> None:
        """Forget a client whose connection is closed."""
        if self._gateway is not None:
            self._gateway.connection_closed(Endpoint(self._name, connection))

    def waiting(self, connection: str) -> int:
        """Return how many requests of a connection wait for their answers."""
        if self._gateway is None:
            return 0
        return self._gateway.tracker.waiting(Endpoint(self._name, connection))

    async def wait_below(self, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection wait."""
        if self._gateway is not None:
            await self._gateway.wait_below(Endpoint(self._name, connection), count)


def _reply_unknown_type(frame: bytes, answer: Callable[[bytes], None]) -> None:
    """Reply that the protocol of a frame is not supported."""
    kind, body = mailbox_error(MailboxError.UNSUPPORTED_PROTOCOL)
    address = int.from_bytes(frame[_ADDRESS], "little")
    answer(encode_plain_frame(kind, address, 0, body))
