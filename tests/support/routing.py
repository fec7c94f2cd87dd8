"""Stations with routers for tests: services that echo, and senders that record packets."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from eap.codec.ams import AmsAnswer
from eap.ids import Endpoint, NetId
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter
from eap.services.transports.demultiplexer import Demultiplexer
from tests.support import aoe
from tests.support.ams import Ams, parse

Reply = Callable[[LocalRequest], AmsAnswer | Awaitable[AmsAnswer]]


def echo(request: LocalRequest) -> AmsAnswer:
    """Answer as a device that sends back what it got."""
    return AmsAnswer(bytes(4) + bytes([request.header.command & 0xFF]) + request.body[::-1])


class StubService:
    """A service that answers with *reply*, and remembers who is gone."""

    def __init__(self, reply: Reply = echo, *ports: int) -> None:
        self.ports = set(ports or (aoe.DEVICE,))
        self.gone: list[Endpoint] = []
        self._reply = reply

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        return self._reply(request)

    def client_gone(self, endpoint: Endpoint) -> None:
        self.gone.append(endpoint)


class RecordingSender:
    """Keeps what is sent by it; *error* says why it cannot."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, Ams]] = []
        self.error: str | None = None

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        if self.error is None:
            self.sent += [(connection, parse(packet)) for packet in packets]
        return self.error


def station(
    target: str = "1.1.1.1.2.1", reply: Reply = echo, *, name: str = "island"
) -> StationRouter:
    """Return the router of a station with one device, its NetID is that but for its end."""
    net_id = NetId.parse(target)
    router = StationRouter(name, NetId([*net_id[:4], 1, 1]), [net_id])
    router.add_service(net_id, StubService(reply))
    return router


def demultiplexer(*stations: StationRouter, transport: str = "link") -> Demultiplexer:
    return Demultiplexer([(each, transport) for each in stations])


async def while_serving(script: Coroutine[Any, Any, Any], *stations: StationRouter) -> Any:
    """Run *script* while *stations* serve; return its result."""
    async with asyncio.TaskGroup() as group:
        serving = [group.create_task(each.serve()) for each in stations]
        try:
            return await asyncio.wait_for(script, 10)
        finally:
            for task in serving:
                task.cancel()
