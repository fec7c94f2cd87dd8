"""Conversations of one asynchronous client side by side: no reply reaches another request."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import (
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_frame,
    encode_frame,
)
from eap.gateway.client import AsyncGatewayClient
from tests.support.fakegateway import FILE, SIZES, FakeGateway

pytestmark = pytest.mark.net

RESEND_S = 0.5
NAME = "x" * 300


class Gateway(asyncio.DatagramProtocol):
    """Gateway whose replies the test sends, in any order and as often as it likes."""

    def __init__(self) -> None:
        self.requests: asyncio.Queue[bytes] = asyncio.Queue()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.peer = addr
        self.requests.put_nowait(data)

    async def request(self) -> tuple[MailboxHeader, bytes]:
        async with asyncio.timeout(10):
            header, body = decode_frame(await self.requests.get())
        return header, bytes(body)

    def reply(self, address: int, kind: MailboxType, body: bytes, counter: int = 0) -> None:
        frame = encode_frame(MailboxHeader(0, address, type=kind, counter=counter), body)
        self.transport.sendto(frame, self.peer)


@asynccontextmanager
async def plant(timeout_s: float) -> AsyncIterator[tuple[Gateway, AsyncGatewayClient]]:
    loop = asyncio.get_running_loop()
    transport, gateway = await loop.create_datagram_endpoint(Gateway, local_addr=("127.0.0.1", 0))
    async with AsyncGatewayClient("127.0.0.1", gateway.port, timeout_s=timeout_s) as client:
        yield gateway, client
    transport.close()


def run(
    scene: Callable[[Gateway, AsyncGatewayClient], Awaitable[None]], timeout_s: float = 20
) -> None:
    async def whole() -> None:
        async with plant(timeout_s) as (gateway, client):
            await scene(gateway, client)

    asyncio.run(whole())


def uploaded(index: int, value: int, subindex: int = 0) -> bytes:
    return struct.pack("<HBHBI", 3 << 12, 0x43, index, subindex, value)


def downloaded(index: int, subindex: int = 0) -> bytes:
    return struct.pack("<HBHBI", 3 << 12, 0x60, index, subindex, 0)


async def all_received(gateway: Gateway, client: AsyncGatewayClient) -> None:
    """Wait until the client has every reply so far: datagrams of loopback keep their order."""
    read = asyncio.ensure_future(client.sdo_read(1009, 0x2000))
    await gateway.request()
    gateway.reply(1009, MailboxType.COE, uploaded(0x2000, 0))
    await read


def value(octets: bytes) -> int:
    return int.from_bytes(octets, "little")


def test_segmented_reads_of_one_slave_at_once_have_their_own_data() -> None:
    async def scene() -> None:
        with FakeGateway() as gateway:
            async with AsyncGatewayClient("127.0.0.1", gateway.port) as client:
                found = await asyncio.gather(
                    client.sdo_read(1001, 0x1008),
                    client.sdo_read(1001, 0x2000),
                    client.sdo_read(1001, 0x1008),
                    client.od_list(1001),
                )
                assert found == [NAME.encode(), bytes(4), NAME.encode(), [0x1008, 0x2000]]

    asyncio.run(scene())


def test_file_and_objects_of_one_slave_at_once_have_their_own_data() -> None:
    async def scene() -> None:
        with FakeGateway() as gateway:
            async with AsyncGatewayClient("127.0.0.1", gateway.port) as client:
                client.mailboxes[1001] = SIZES
                found = await asyncio.gather(
                    client.foe_read(1001, "f"),
                    client.sdo_read(1001, 0x1008),
                    client.voe(1001, 5, 1, b"a"),
                    client.foe_read(1001, "f"),
                )
                assert found == [FILE, NAME.encode(), b"a", FILE]

    asyncio.run(scene())


def test_replies_of_two_slaves_in_the_other_order_reach_their_requests() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        async with asyncio.TaskGroup() as group:
            first = group.create_task(client.sdo_read(1001, 0x2000))
            second = group.create_task(client.sdo_read(1002, 0x2000))
            headers = [(await gateway.request())[0] for _ in range(2)]
            for header in reversed(headers):
                # The counter is the other request's: slaves number their own messages.
                other = 3 - header.counter
                body = uploaded(0x2000, header.address)
                gateway.reply(header.address, MailboxType.COE, body, other)
        assert (value(first.result()), value(second.result())) == (1001, 1002)

    run(scene)


def test_each_slave_gets_counters_in_order() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        counters: dict[int, list[int]] = {1001: [], 1002: []}

        async def serve() -> None:
            while True:
                header, _ = await gateway.request()
                counters[header.address].append(header.counter)
                gateway.reply(header.address, MailboxType.COE, uploaded(0x2000, 0))

        server = asyncio.ensure_future(serve())
        await client.sdo_read(1001, 0x2000)
        for _ in range(6):
            await client.sdo_read(1002, 0x2000)
        await client.sdo_read(1001, 0x2000)
        server.cancel()
        assert counters == {1001: [1, 2], 1002: [1, 2, 3, 4, 5, 6]}

    run(scene)


def test_late_reply_to_a_request_sent_twice_does_not_answer_the_next_one() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        first = asyncio.ensure_future(client.sdo_read(1001, 0x2000))
        one, two = await gateway.request(), await gateway.request()
        assert one == two, "the same octets: the gateway may know it"
        gateway.reply(1001, MailboxType.COE, uploaded(0x2000, 1))
        assert value(await first) == 1
        second = asyncio.ensure_future(client.sdo_read(1001, 0x2000))
        await asyncio.sleep(0)
        gateway.reply(1001, MailboxType.COE, uploaded(0x2000, 1))  # to the second datagram
        await gateway.request()
        gateway.reply(1001, MailboxType.COE, uploaded(0x2000, 2))
        assert value(await second) == 2

    run(scene, RESEND_S)


def test_confirmation_of_a_write_sent_twice_does_not_confirm_the_next_one() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        first = asyncio.ensure_future(client.sdo_write(1001, 0x2000, 0, b"1"))
        await gateway.request()
        await gateway.request()
        gateway.reply(1001, MailboxType.COE, downloaded(0x2000))
        await first
        second = asyncio.ensure_future(client.sdo_write(1001, 0x2000, 0, b"2"))
        await asyncio.sleep(0)
        gateway.reply(1001, MailboxType.COE, downloaded(0x2000))
        await gateway.request()
        await all_received(gateway, client)
        assert not second.done(), "confirmed before it was executed"
        gateway.reply(1001, MailboxType.COE, downloaded(0x2000))
        await second

    run(scene, RESEND_S)


def test_late_segment_of_a_request_sent_twice_is_not_taken_for_a_later_one() -> None:
    """Segments say no more than a bit that toggles."""

    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        read = asyncio.ensure_future(client.sdo_read(1001, 0x2000))
        await gateway.request()
        gateway.reply(1001, MailboxType.COE, struct.pack("<HBHBI", 3 << 12, 0x41, 0x2000, 0, 24))
        segment = [struct.pack("<HB", 3 << 12, (n & 1) << 4 | (n == 2)) + bytes([n]) * 8
                   for n in range(3)]  # fmt: skip
        await gateway.request()
        await gateway.request()  # the first segment, twice
        gateway.reply(1001, MailboxType.COE, segment[0])
        await gateway.request()
        gateway.reply(1001, MailboxType.COE, segment[1])
        await all_received(gateway, client)
        gateway.reply(1001, MailboxType.COE, segment[0])
        await gateway.request()
        gateway.reply(1001, MailboxType.COE, segment[2])
        assert await read == bytes(8) + b"\1" * 8 + b"\2" * 8

    run(scene, RESEND_S)


def test_mailbox_error_of_one_protocol_does_not_end_another_transfer() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        read = asyncio.ensure_future(client.sdo_read(1001, 0x2000))
        vendor = asyncio.ensure_future(client.voe(1001, 5, 1, b""))
        await gateway.request()
        await gateway.request()
        gateway.reply(1001, MailboxType.ERR, MailboxErrorReply(detail=2).encode())
        gateway.reply(1001, MailboxType.COE, uploaded(0x2000, 7))
        assert value(await read) == 7
        header, _ = await gateway.request()
        assert header.type is MailboxType.VOE
        gateway.reply(1001, MailboxType.ERR, MailboxErrorReply(detail=2).encode())
        with pytest.raises(MailboxRefusedError, match="UNSUPPORTED_PROTOCOL"):
            await vendor

    run(scene)


def test_cancelled_transfer_leaves_no_reply_for_the_next_one() -> None:
    async def scene(gateway: Gateway, client: AsyncGatewayClient) -> None:
        client.mailboxes[1001] = MailboxSizes(128, 128)
        read = asyncio.ensure_future(client.foe_read(1001, "old"))
        await gateway.request()
        read.cancel()
        with pytest.raises(asyncio.CancelledError):
            await read
        _, abort = await gateway.request()
        assert abort[0] == 5, "an FoE error ends the transfer at the slave"
        again = asyncio.ensure_future(client.foe_read(1001, "new"))
        await asyncio.sleep(0)
        gateway.reply(1001, MailboxType.FOE, b"\3\0\1\0\0\0old")
        _, request = await gateway.request()
        assert request.endswith(b"new")
        gateway.reply(1001, MailboxType.FOE, b"\3\0\1\0\0\0new")
        assert await again == b"new"

    run(scene)
