"""Requests of this process itself: to services of its stations, and through routes to others."""

from __future__ import annotations

import asyncio
from itertools import count
from typing import Protocol

from eap.ads.answer import AmsAnswer
from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader, StateFlags, decode_packet, encode_packet
from eap.ids import NetId

LOCAL_TRANSPORT = Transport(TransportKind.LOCAL, is_stream=True, is_hub=True)
"""By which a station's own requests come into its router."""
_FIRST_PORT = 0x8000
"""As clients of AMS routers have them."""


class _Station(Protocol):
    @property
    def net_id(self) -> NetId: ...

    def receive(self, data: bytes, transport: str, connection: str) -> None: ...

    def connection_closed(self, transport: str, connection: str) -> None: ...


class LocalClient:
    """The client of one station, and the carrier that brings the answers back to it.

    Each request is a connection of its own, so that all may be under way at a time.
    """

    def __init__(self, station: _Station) -> None:
        self._station = station
        self._numbers = count(1)
        self._waiting: dict[str, asyncio.Future[AmsAnswer]] = {}

    async def ask(
        self, target: NetId, target_port: int, command: int, body: bytes, *, timeout_s: float
    ) -> AmsAnswer:
        """Ask, and return the answer, or the error that there is instead of one."""
        number = next(self._numbers)
        connection = str(number)
        answer: asyncio.Future[AmsAnswer] = asyncio.get_running_loop().create_future()
        self._waiting[connection] = answer
        source_port = _FIRST_PORT + number % _FIRST_PORT
        header = AmsHeader(
            target, target_port, self._station.net_id, source_port, command, StateFlags.ADS,
            invoke_id=number & 0xFFFFFFFF,
        )  # fmt: skip
        try:
            self._station.receive(encode_packet(header, body), LOCAL_TRANSPORT.name, connection)
            async with asyncio.timeout(timeout_s):
                return await answer
        except TimeoutError:
            return AmsAnswer(error_code=AdsError.TIMEOUT)
        finally:
            del self._waiting[connection]
            self._station.connection_closed(LOCAL_TRANSPORT.name, connection)

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Take an answer."""
        answer = self._waiting.get(connection)
        if answer is not None and not answer.done():
            header, body = decode_packet(packets[0])
            answer.set_result(AmsAnswer(bytes(body), header.error_code))
        return None
