"""Controllers and clients that hang, talk nonsense or flood: the bridge's drivers by themselves."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from eap.bridges.bridge import Bridge
from eap.bridges.field import server as field_server
from eap.bridges.field.client import ControllerPoints, FieldClient
from eap.bridges.field.plan import PointKey
from eap.bridges.field.server import FieldServing, open_server
from eap.bridges.modbus.link import ModbusLink
from eap.bridges.modbus.session import ModbusSession
from eap.codec import datatypes
from eap.codec.fieldaddresses import modbus_point
from eap.config.bridge_sections import FieldServer, ModbusController, ServedItem
from eap.errors import EnvironmentalError
from eap.live.client import LiveClient
from eap.live.transport import PlantConnection, gone
from eap.runtime.bridges import BridgeFile, PeerStatus
from tests.support.eventually import eventually

pytestmark = pytest.mark.net

HOST = "127.9.81.1"
KEY = PointKey("mill", "power")


async def no_plant() -> PlantConnection:
    raise gone("it does not run")


def bridge(folder: Path) -> Bridge:
    return Bridge(
        "line",
        "line",
        lambda: LiveClient(no_plant),
        ready=lambda: None,
        file=BridgeFile(folder, "modbus"),
        pid=1,
    )


Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def client_of(folder: Path, port: int, handler: Handler) -> AsyncIterator[PeerStatus]:
    """Run a client of a device that behaves as *handler*."""
    controller = ModbusController(host=HOST, every_ms=10, timeout_ms=100)
    point = modbus_point(datatypes.parse("REAL"), "holding:0")
    status = PeerStatus(name="meter", url="modbus://meter")
    points = ControllerPoints({KEY: point}, {})
    client = FieldClient(
        bridge(folder), controller, port, points, status, lambda: ModbusLink(controller)
    )
    server = await asyncio.start_server(handler, HOST, port)
    task = asyncio.create_task(client.run())
    try:
        yield status
    finally:
        task.cancel()
        await asyncio.wait([task])
        server.close()


async def hang(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read()
    writer.close()


async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read(1)
    writer.close()


async def talk_nonsense(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    writer.write(b"SSH-2.0-OpenSSH_9.2p1\r\n")
    await reader.read()
    writer.close()


async def answer_another(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read(12)
    writer.write(bytes.fromhex("ffff 0000 0007 01 03 04 3f800000"))
    await reader.read()
    writer.close()


async def answer_short(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while request := await reader.read(12):
        writer.write(request[:2] + bytes.fromhex("0000 0005 01 03 02 3f80"))
    writer.close()


@pytest.mark.parametrize(
    ("port", "handler", "reason"),
    [
        (1502, hang, "no answer within 0.1 s"),
        (1503, hang_up, "closed the connection"),
        (1504, talk_nonsense, "MBAP"),
        (1505, answer_another, "replies to another request"),
    ],
)
def test_connection_to_a_broken_device_is_given_up_with_its_reason(
    tmp_path: Path, port: int, handler: Handler, reason: str
) -> None:
    async def run() -> None:
        async with client_of(tmp_path, port, handler) as status:
            await eventually(lambda: reason in status.reason and not status.is_up)
            await eventually(lambda: status.connects > 1)

    asyncio.run(run())


def test_value_that_is_cut_off_fails_alone(tmp_path: Path) -> None:
    async def run() -> None:
        async with client_of(tmp_path, 1506, answer_short) as status:
            await eventually(lambda: status.failed == 1 and status.reads > 2)
            assert status.is_up
            assert status.reason == "mill/power: the device sent 2 of 4 bytes"
            assert status.connects == 1

    asyncio.run(run())


@asynccontextmanager
async def serving(folder: Path, port: int) -> AsyncIterator[Any]:
    items = (ServedItem("mill/level", "UINT", "holding:0", write=True),)
    found = bridge(folder)
    made = FieldServing(
        found,
        FieldServer(f"{HOST}:{port}", 100, items, 1),
        "modbus",
        lambda memory: ModbusSession(memory, 1),
    )
    made.memory.update("mill/level", 7)
    task = asyncio.create_task(made.run())
    try:
        await eventually(lambda: found.status.is_up)
        yield found
    finally:
        task.cancel()
        await asyncio.wait([task])


READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")


def test_one_host_does_not_take_all_places_of_a_server(tmp_path: Path) -> None:
    async def run() -> None:
        async with serving(tmp_path, 1507) as found:
            crowd = [
                await asyncio.open_connection(HOST, 1507, local_addr=("127.9.81.2", 0))
                for _ in range(field_server.MAX_CLIENTS_OF_HOST + 3)
            ]
            await eventually(lambda: found.status.dropped == 3)
            reader, writer = await asyncio.open_connection(HOST, 1507, local_addr=("127.9.81.3", 0))
            writer.write(READ)
            assert (await reader.readexactly(11))[-2:] == b"\0\7"
            assert found.status.clients == field_server.MAX_CLIENTS_OF_HOST + 1
            for _, each in [*crowd, (reader, writer)]:
                each.close()
            await eventually(lambda: found.status.clients == 0)

    asyncio.run(run())


def test_client_that_leaves_a_frame_unfinished_is_disconnected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_server, "UNFINISHED_S", 0.1)

    async def run() -> None:
        async with serving(tmp_path, 1508) as found:
            reader, writer = await asyncio.open_connection(HOST, 1508)
            writer.write(READ[:7])
            assert await reader.read() == b""
            writer.close()
            await eventually(lambda: found.status.clients == 0)

    asyncio.run(run())


def test_pipelined_requests_are_answered_in_order_and_a_write_without_plant_is_refused(
    tmp_path: Path,
) -> None:
    async def run() -> None:
        async with serving(tmp_path, 1509) as found:
            reader, writer = await asyncio.open_connection(HOST, 1509)
            writer.write(READ + bytes.fromhex("0002 0000 0006 01 06 0000 0009") + READ)
            data = await reader.readexactly(11 + 9 + 11)
            assert data.hex()[22:40] == "000200000003018604"
            assert data[-2:] == b"\0\7"
            assert (found.status.received, found.status.refused) == (1, 1)
            writer.close()

    asyncio.run(run())


def test_port_that_is_taken_is_named() -> None:
    with socket.create_server((HOST, 1510)), pytest.raises(EnvironmentalError) as caught:
        open_server(f"{HOST}:1510")
    assert str(caught.value) == f"{HOST}:1510: Address already in use"
