"""Another station as sessions of a gateway reach it: a table of one answer, or a bus."""

from __future__ import annotations

import asyncio

from eap.ads.request import Operation, OperationOutcome, encode_outcome, parse_request
from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer
from eap.services.slaves.remote_slave import RemoteSlave
from tests.support import busads


class Station:
    """Gives *data*, or refuses with *result*.

    Attributes:
        asked: Operations, in their order.
        hangs: Whether it says nothing at all.
    """

    def __init__(self, data: bytes = b"", result: int = 0) -> None:
        self.asked: list[Operation] = []
        self.data = data
        self.result = result
        self.hangs = False

    async def ask(self, port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
        """Answer a request."""
        del port, timeout_s
        (operation,) = parse_request(command, body).operations
        self.asked.append(operation)
        if self.hangs:
            await asyncio.Event().wait()
        return AmsAnswer(encode_outcome(command, OperationOutcome(self.result, self.data)))

    def link(self, answer_s: float = 0.05) -> RemoteSlave:
        """Return a way to its slave."""
        return RemoteSlave(self.ask, 1001, answer_s)


class Bus:
    """The services of a bus, asked by a gateway somewhere else.

    Attributes:
        asked: Operations, in their order.
        is_gone: Whether requests get no answer any more.
    """

    def __init__(self, client: busads.Client) -> None:
        self.asked: list[Operation] = []
        self.is_gone = False
        self._client = client

    async def ask(self, port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
        """Answer a request, or nothing until its time is over."""
        if self.is_gone:
            await asyncio.sleep(timeout_s)
            return AmsAnswer(error_code=AdsError.TIMEOUT)
        self.asked.extend(parse_request(command, body).operations)
        return await self._client.answer(port, command, body)

    def link(self, station: int = 1001, answer_s: float = 1) -> RemoteSlave:
        """Return a way to a slave."""
        return RemoteSlave(self.ask, station, answer_s)
