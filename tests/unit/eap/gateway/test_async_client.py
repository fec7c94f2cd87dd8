"""The asynchronous client against a gateway in a thread."""

from __future__ import annotations

import asyncio

import pytest

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import Progress
from eap.codec.soe import Idn
from eap.errors import EnvironmentalError
from eap.gateway.client import AsyncGatewayClient
from tests.support.fakegateway import FILE, SIZES, FakeGateway

MODE = Idn.parse("S-0-0032")

pytestmark = pytest.mark.net


@pytest.fixture(scope="module")
def gateway():
    with FakeGateway() as running:
        yield running


def test_all_services(gateway) -> None:
    async def run() -> None:
        async with AsyncGatewayClient("127.0.0.1", gateway.port) as client:
            await client.sdo_write(1001, 0x2000, 0, b"1234")
            assert await client.sdo_read(1001, 0x2000) == b"1234"
            await client.sdo_write(1001, 0x1008, 0, b"y" * 400)
            assert await client.sdo_read(1001, 0x1008) == b"y" * 400
            assert await client.od_list(1001) == [0x1008, 0x2000]
            assert (await client.od_object(1001, 0x2000)).name == "A"
            assert (await client.od_entry(1001, 0x2000, 0)).bit_length == 32
            progress = Progress()
            await client.foe_write(1001, "f", FILE, progress=progress)
            assert progress.done == len(FILE)
            assert await client.foe_read(1001, "f") == FILE
            await client.idn_write(1001, MODE, bytes((7, 0, 0, 0)))
            assert (await client.idn_describe(1001, MODE)).name == "Mode"
            assert await client.voe(1001, 0x1164, 1, b"\1") == b"\1"
            assert await client.idn_read(1001, MODE) == bytes((7, 0, 0, 0))
            assert [slave.name for slave in await client.slaves()] == ["drive"]

    asyncio.run(run())


def test_client_of_a_gateway_that_is_silent_at_address_0_writes_objects_and_idns() -> None:
    async def run() -> None:
        with FakeGateway() as gateway:
            gateway.is_master_silent = True
            place = "127.0.0.1", gateway.port
            async with AsyncGatewayClient(*place, timeout_s=0.01, tries=20) as client:
                await client.sdo_write(1001, 0x1008, 0, b"y" * 400)
                await client.idn_write(1001, MODE, bytes((7, 0, 0, 0)))
                assert await client.sdo_read(1001, 0x1008) == b"y" * 400
                with pytest.raises(MailboxTimeoutError):
                    await client.foe_read(1001, "f")
                client.mailboxes[1001] = SIZES
                assert await client.foe_read(1001, "f") == FILE

    asyncio.run(run())


def test_requests_wait_side_by_side(gateway) -> None:
    async def run() -> None:
        async with AsyncGatewayClient("127.0.0.1", gateway.port) as client:
            asked = [client.sdo_read(0, 0x1008), client.sdo_read(0, 0xF020, 1)]
            assert await asyncio.gather(*asked) == [b"M", b"\xe9\x03"]

    asyncio.run(run())


def test_async_client_repeats_lost_datagrams(gateway) -> None:
    async def run() -> None:
        place = "127.0.0.1", gateway.port
        async with AsyncGatewayClient(*place, timeout_s=0.02, tries=50) as client:
            gateway.drop = 2
            assert await client.sdo_read(0, 0x1008) == b"M"
        async with AsyncGatewayClient(*place, timeout_s=0.05) as client:
            gateway.drop = 3
            with pytest.raises(MailboxTimeoutError):
                await client.sdo_read(0, 0x1008)

    asyncio.run(run())


def test_a_host_without_an_address() -> None:
    async def run() -> None:
        with pytest.raises(EnvironmentalError, match=r"gateway no\.such\.host\.invalid"):
            async with AsyncGatewayClient("no.such.host.invalid"):
                pass

    asyncio.run(run())
