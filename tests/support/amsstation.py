"""A station as listeners know one, whose devices send back what they get."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsHeader, response_to
from eap.ids import NetId

Send: TypeAlias = Callable[[str, Iterable[bytes]], str | None]


class EchoStation:
    """Answers at once, or, where it is slow, when ``answer`` is called.

    Attributes:
        send: How answers go back; to be set.
        seen: Packets, with transport and connection, that came.
        closed: Transports and connections that were closed.
        waiting: Answers that nobody has sent yet.
    """

    def __init__(
        self, *devices: str, routes: Iterable[str] = (), is_slow: bool = False, grows: int = 1
    ) -> None:
        self._devices = {NetId.parse(each) for each in devices}
        self._routes = {NetId.parse(each) for each in routes}
        self._is_slow = is_slow
        self._grows = grows
        self.send: Send
        self.seen: list[tuple[bytes, str, str]] = []
        self.closed: list[tuple[str, str]] = []
        self.waiting: list[tuple[str, bytes]] = []

    @property
    def table(self) -> EchoStation:
        return self

    def find(self, net_id: NetId) -> tuple[None, int] | None:
        return (None, 6) if net_id in self._routes else None

    @property
    def net_ids(self) -> set[NetId]:
        return self._devices

    def is_waiting_for(self, header: AmsHeader, body: bytes, transport: str) -> bool:
        return False

    def receive(
        self, data: bytes, transport: str, connection: str, *, is_broadcast: bool = False
    ) -> None:
        self.seen.append((data, transport, connection))
        header = AmsHeader.decode(data)
        error = AdsError.TARGET_MACHINE
        if header.target in self._devices | self._routes:
            error = AdsError.NONE
        if not header.state_flags & 2:
            answer = AmsAnswer(data[AmsHeader.SIZE :] * self._grows, error)
            self.waiting.append((connection, response_to(header, answer)))
        if not self._is_slow:
            self.answer()

    def connection_closed(self, transport: str, connection: str) -> None:
        self.closed.append((transport, connection))

    def answer(self, number: int = 0) -> None:
        """Send the answer to the request with this number of those that wait."""
        if self.waiting:
            connection, packet = self.waiting.pop(number)
            self.send(connection, (packet,))
