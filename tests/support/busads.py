"""A client of the services of a bus port, whose slaves are simulated in the loop of the test."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

from eap.ads.request import (
    Operation,
    OperationOutcome,
    Read,
    ReadWrite,
    Write,
    decode_outcome,
    encode_query,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsHeader
from eap.ids import Endpoint, NetId
from eap.services.ads.bus_ads import BusService
from eap.services.ads.slave_notifications import SamplingBudget
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.engine_link import EngineLink
from eap.services.routing.service import LocalRequest
from eap.services.slaves.bus_client import BusClient
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

BUS = NetId.parse("5.1.1.1.3.1")
TOOL = NetId.parse("7.7.7.7.1.1")
MASTER = 0xFFFF
DRIVE = 1001


class Client:
    """Asks like a tool.

    Attributes:
        service: That it asks.
        told: Notifications, with the ways that they went.
        why: What was told of the last answer, for people.
    """

    def __init__(
        self,
        service: BusService,
        bus: BusClient,
        told: Sequence[tuple[Endpoint, bytes]] = (),
        net_id: NetId = TOOL,
    ) -> None:
        self.service = service
        self.net_id = net_id
        self.endpoint = Endpoint("ams-tcp", "1")
        self.why = ""
        self.bus = bus
        self.told = told

    async def answer(self, port: int, command: int, body: bytes) -> AmsAnswer:
        """Return the answer as it is."""
        header = AmsHeader(BUS, port, self.net_id, 30000, command, length=len(body))
        answer = await self.service.answer(LocalRequest(header, body, self.endpoint))
        self.why = answer.why
        return answer

    async def do(self, port: int, operation: Operation) -> OperationOutcome:
        """Return how an operation came out."""
        command, body = encode_query(operation)
        answer = await self.answer(port, command, body)
        return decode_outcome(command, answer.error_code, answer.data)

    async def good(self, port: int, operation: Operation) -> bytes:
        """Return the data of an operation that succeeds."""
        outcome = await self.do(port, operation)
        assert not outcome.result, f"{AdsError.name_of(outcome.result)}: {self.why}"
        return outcome.data

    async def read(self, port: int, group: int, offset: int, length: int = 1 << 19) -> bytes:
        return await self.good(port, Read(group, offset, length))

    async def write(self, port: int, group: int, offset: int, data: bytes = b"") -> None:
        await self.good(port, Write(group, offset, data))

    async def ask(
        self, port: int, group: int, offset: int, data: bytes = b"", length: int = 1 << 19
    ) -> bytes:
        return await self.good(port, ReadWrite(group, offset, length, data))

    async def open_file(self, port: int, group: int, name: bytes, password: int = 0) -> int:
        """Return the handle of a file."""
        return int.from_bytes(await self.ask(port, group, password, name, 4), "little")

    async def read_file(self, port: int, handle: int, block: int) -> bytes:
        """Return the rest of a file, and close it."""
        content, last = b"", block
        while last == block:
            octets = await self.ask(port, IndexGroup.FOE_READ, handle, length=block)
            content, last = content + octets, len(octets)
        await self.ask(port, IndexGroup.FOE_CLOSE, handle)
        return content


async def until(look: Callable[[], Awaitable[bool]]) -> None:
    """Wait until something is so."""
    for _ in range(1000):
        if await look():
            return
        await asyncio.sleep(0.005)
    raise AssertionError("it does not happen")


BUSES = {
    "files": """
bus: files
slaves:
  - name: disk
    kind: generic
    mailbox: {size: 256, foe: true}
    files:
      - {name: a.bin, content: "first file", max_size: 100000}
      - {name: small.bin, max_size: 1000}
      - {name: locked.bin, password: 42, content: secret}
      - {name: boot.bin, boot_only: true}
  - name: other
    kind: generic
    mailbox: {size: 128, foe: true}
""",
    "aoe": """
bus: aoe
slaves:
  - name: talker
    kind: generic
    mailbox: {size: 64, coe: false, aoe: true}
    objects:
      - {index: 0x8001, name: Long, type: BLOCK(500)}
      - {index: 0x8002, name: Number, type: UDINT, value: 7}
  - name: mute
    kind: generic
    mailbox: null
""",
}
"""Buses of these tests; others are those of ``config``."""


def play(
    scene: Callable[[Client, FakeEngine], Awaitable[Any]],
    name: str = "drive",
) -> Any:
    """Run *scene* with a client and the engine behind the service that it asks."""

    async def run() -> Any:
        engine = FakeEngine(FakeBus(_line(name)))
        link = EngineLink(engine.services)
        bus = BusClient(link, 0, PORT)
        told: list[tuple[Endpoint, bytes]] = []
        provider = MasterDictionaryProvider(bus, "1.2.3")
        service = BusService(
            bus,
            BUS,
            "1.2.3",
            lambda endpoint, packet: told.append((endpoint, packet)),
            provider,
            SamplingBudget(),
        )
        try:
            async with asyncio.timeout(20):
                return await scene(Client(service, bus, told), engine)
        finally:
            link.close()
            engine.close()
            await asyncio.sleep(0)

    return run_virtual(run())


def _line(name: str) -> LoopBus:
    if name not in BUSES:
        return LoopBus(name)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / f"{name}.yaml").write_text(BUSES[name])
        return LoopBus(name, Path(folder))
