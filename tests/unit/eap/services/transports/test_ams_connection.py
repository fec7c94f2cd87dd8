"""One AMS/TCP connection, from the first packet to its end."""

from __future__ import annotations

import asyncio
import itertools
import socket
import struct
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from time import monotonic_ns
from typing import Any, TypeAlias

import pytest

from eap.codec.ams import AmsAnswer, AmsHeader, response_to
from eap.ids import NetId
from eap.net.limits import CloseReason
from eap.net.tcp import set_stream_options
from eap.runtime.drop_counters import DropReason
from eap.services.transports import ams_connection
from eap.services.transports.ams_connection import (
    AmsConnection,
    ClientAddresses,
)
from tests.support import aoe
from tests.support.eventually import eventually, settle

pytestmark = pytest.mark.net

TARGET = "1.1.1.1.2.1"
NO_RETURN = 4 | 2
Script: TypeAlias = Callable[
    [asyncio.StreamReader, asyncio.StreamWriter, "Taker"], Awaitable[object]
]


def ask(body: bytes = b"abc", number: int = 1, command: int = aoe.READ_STATE, **more: Any) -> bytes:
    return prefixed(aoe.packet(TARGET, command, body, invoke_id=number, **more))


def prefixed(packet: bytes, *, reserved: int = 0, length: int | None = None) -> bytes:
    return struct.pack("<HI", reserved, len(packet) if length is None else length) + packet


class Taker:
    """Echoes at once, or when ``answer`` is called."""

    def __init__(self, *, is_slow: bool = False, grows: int = 1) -> None:
        self.is_slow = is_slow
        self.grows = grows
        self.connection: AmsConnection
        self.waiting: list[bytes] = []
        self.seen: list[bytes] = []
        self.answers: list[bytes] = []
        self.refused: list[DropReason] = []
        self.why = ""
        self.closed = asyncio.Event()

    def connection_opened(self, connection: AmsConnection) -> None:
        self.connection = connection

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        assert connection is self.connection
        self.seen.append(packet)
        header = AmsHeader.decode(packet)
        if not header.state_flags & 2:
            body = packet[AmsHeader.SIZE :] * self.grows
            self.waiting.append(response_to(header, AmsAnswer(body)))
            if not self.is_slow:
                self.answer()

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        self.answers.append(packet)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        assert not self.closed.is_set()
        self.why = why
        self.closed.set()

    def count_dropped(self, reason: DropReason) -> None:
        self.refused.append(reason)

    def answer(self, number: int = 0) -> None:
        self.connection.send([self.waiting.pop(number)])


ADDRESSES = ClientAddresses(0x100)


def is_taken(net_id: NetId) -> bool:
    """Say whether a station has a NetID; some have the usual one, some any other."""
    return net_id[4:] == b"\1\1" or net_id[5] % 2 == 0


def talk(script: Script, *, patience_s: float = 5, is_outgoing: bool = False, **more: Any) -> Taker:
    """Run ``script(reader, writer, taker)`` on a connection, and wait for its end."""
    made: list[Taker] = []

    async def run() -> None:
        loop = asyncio.get_running_loop()
        taker = Taker(**more)
        made.append(taker)
        with socket.create_server(("127.0.0.1", 0)) as listener:
            ours = socket.create_connection(listener.getsockname())
            theirs, (host, port) = listener.accept()
        set_stream_options(theirs)
        connection = AmsConnection(
            f"{host}:{port}#1",
            host,
            taker,
            is_outgoing=is_outgoing,
            assign_address=None if is_outgoing else partial(ADDRESSES.next, taken=is_taken),
        )
        await loop.connect_accepted_socket(lambda: connection, theirs)
        reader, writer = await asyncio.open_connection(sock=ours)
        watch = asyncio.ensure_future(look_for_slow(connection, taker, patience_s))
        try:
            async with asyncio.timeout(10):
                await script(reader, writer, taker)
                writer.close()
                await taker.closed.wait()
        finally:
            writer.transport.abort()
            watch.cancel()
            connection.close("the test ends")
            await taker.closed.wait()

    asyncio.run(run())
    return made[0]


async def look_for_slow(connection: AmsConnection, taker: Taker, patience_s: float) -> None:
    while not taker.closed.is_set():
        await asyncio.sleep(patience_s / 4)
        late_ns = connection.late_since_ns
        if late_ns is not None and monotonic_ns() - late_ns >= patience_s * 1e9:
            connection.close(CloseReason.OVERDUE)


async def hear(reader: asyncio.StreamReader) -> tuple[int, int, bytes]:
    """Return error, invoke id and data of the next packet."""
    reserved, length = struct.unpack("<HI", await reader.readexactly(6))
    packet = await reader.readexactly(length)
    flags, size, error, number = struct.unpack_from("<HIII", packet, 18)
    assert (reserved, flags & 1, size) == (0, 1, length - 32)
    assert packet[:6] == aoe.net_id(aoe.CLIENT)
    return error, number, packet[32:]


def test_requests_are_answered_however_they_are_cut() -> None:
    async def script(reader, writer, taker):
        octets = ask(b"1", 1) + ask(b"2" * 3000, 2) + ask(b"3", 3)
        for begin, end in ((0, 1), (1, 7), (7, 60), (60, 900), (900, len(octets))):
            writer.write(octets[begin:end])
            await writer.drain()
            await settle()
        answers = [await hear(reader) for _ in range(3)]
        assert answers == [(0, 1, b"1"), (0, 2, b"2" * 3000), (0, 3, b"3")]

    assert talk(script).refused == []


def test_several_requests_are_under_way_and_answered_in_any_order() -> None:
    async def script(reader, writer, taker):
        writer.write(b"".join(ask(bytes([n]), n) for n in range(30)))
        await eventually(lambda: len(taker.waiting) == 30)
        for number in range(29, -1, -1):
            taker.answer(number)
            assert await hear(reader) == (0, number, bytes([number]))

    talk(script, is_slow=True)


def test_connection_with_many_pending_requests_is_not_read() -> None:
    async def script(reader, writer, taker):
        count = ams_connection.MAX_REQUESTS
        for n in range(3 * count):
            writer.write(ask(b"x", n))
        await eventually(lambda: len(taker.waiting) == count)
        await settle()
        assert len(taker.waiting) == count
        for n in range(3 * count):
            await eventually(lambda: taker.waiting)
            taker.answer()
            assert (await hear(reader))[1] == n
            assert len(taker.waiting) <= count

    talk(script, is_slow=True)


def test_few_packets_are_taken_in_one_turn() -> None:
    async def script(reader, writer, taker):
        seen = []

        def look():
            seen.append(len(taker.seen))
            if seen[-1] < 100:
                asyncio.get_running_loop().call_soon(look)

        writer.write(ask(b"x") * 100)
        look()
        for _ in range(100):
            await hear(reader)
        steps = {now - before for before, now in itertools.pairwise(seen)}
        assert max(steps) <= ams_connection._PER_TURN

    talk(script)


@pytest.mark.parametrize("flags", [4, NO_RETURN])
def test_wrong_lengths_are_answered_and_the_connection_goes_on(flags: int) -> None:
    whole = aoe.packet(TARGET, 4, b"abc", flags=flags)
    huge = prefixed(aoe.packet(TARGET, 4, bytes(ams_connection.LONGEST_PACKET), flags=flags))

    async def script(reader, writer, taker):
        writer.write(prefixed(whole + b"surplus") + prefixed(whole[:-1]) + huge + ask(b"x", 9))
        if flags == 4:
            assert [(await hear(reader))[0] for _ in range(3)] == [0xE, 0xE, 0xE]
        assert (await hear(reader))[:2] == (0, 9)

    assert talk(script).refused == [DropReason.AMS_LENGTH] * 3


@pytest.mark.parametrize("octets", [b"GET / HTTP/1.1\r\n", prefixed(b""), prefixed(b"", length=31)])
def test_invalid_packet_closes_the_connection_after_pending_answers(octets) -> None:
    async def script(reader, writer, taker):
        writer.write(ask() + ask() + octets)
        await eventually(lambda: taker.refused)
        assert not taker.closed.is_set()
        taker.answer()
        taker.answer()
        assert (await hear(reader))[0] == 0
        assert (await hear(reader))[0] == 0
        assert await reader.read() == b""

    taker = talk(script, is_slow=True)
    assert taker.refused == [DropReason.AMS_TYPE]
    assert taker.why.startswith("no AMS packets: AmsTcpHeader")


def test_client_gets_a_unique_ams_address() -> None:
    addresses = []

    async def script(reader, writer, taker):
        for _ in range(2):
            writer.write(prefixed(b"\0\0", reserved=0x1000))
        writer.write(prefixed(bytes(4), reserved=0x1002) + ask(b"x", 9))
        first, second = [await reader.readexactly(14) for _ in range(2)]
        assert first[:10] == second[:10] == bytes.fromhex("0010 08000000 7f000001")
        assert first[10:12] == second[10:12]
        assert first[12:] != second[12:]
        addresses.append(first[6:12])
        net_id = bytes.fromhex("0210 06000000") + first[6:12]
        assert await reader.readexactly(12) == net_id
        assert (await hear(reader))[:2] == (0, 9)
        writer.write(prefixed(first[12:], reserved=1))
        assert await reader.read() == b""

    for _ in range(2):
        taker = talk(script)
        assert not taker.refused
        assert taker.why == "the client closed its port"
    assert addresses[0] != addresses[1]
    assert not any(map(is_taken, map(NetId, addresses)))


@pytest.mark.parametrize(
    ("port", "is_outgoing", "why"),
    [(30012, False, "a client cannot serve AMS port 30012"), (0, True, "a router requests")],
)
def test_request_to_serve_a_port_closes_the_connection(port, is_outgoing, why) -> None:
    async def script(reader, writer, taker):
        writer.write(prefixed(port.to_bytes(2, "little"), reserved=0x1000))
        assert await reader.read() == b""

    taker = talk(script, is_outgoing=is_outgoing)
    assert taker.refused == [DropReason.AMS_TYPE]
    assert taker.why.startswith(f"no AMS packets: {why}")


def test_answers_and_requests_are_handled_apart() -> None:
    async def script(reader, writer, taker):
        writer.write(ask(flags=5) + ask(b"x", 2))
        assert (await hear(reader))[1] == 2

    taker = talk(script)
    assert (len(taker.answers), len(taker.seen)) == (1, 1)


def test_no_return_request_gets_no_answer() -> None:
    async def script(reader, writer, taker):
        writer.write(ask(flags=NO_RETURN) + ask(b"x", 2))
        assert (await hear(reader))[1] == 2

    assert len(talk(script).seen) == 2


def test_packet_that_is_not_finished_ends_the_connection() -> None:
    async def script(reader, writer, taker):
        for octet in ask()[:30]:
            writer.write(bytes([octet]))
            with suppress(TimeoutError):
                await asyncio.wait_for(taker.closed.wait(), 0.01)
                return

    taker = talk(script, patience_s=0.1)
    assert taker.refused == [DropReason.AMS_SLOW]
    assert taker.why.startswith("too slow")


def test_silence_between_packets_may_last() -> None:
    async def script(reader, writer, taker):
        for number in (1, 2):
            writer.write(ask(b"x", number))
            assert (await hear(reader))[1] == number
            assert taker.connection.late_since_ns is None

    talk(script)


def test_own_connection_is_not_late_while_bytes_of_a_long_answer_come() -> None:
    async def script(reader, writer, taker):
        connection = taker.connection
        answer = prefixed(bytes(4000))
        writer.write(answer[:1000])
        await eventually(lambda: connection.late_since_ns is not None)
        before_ns = connection.late_since_ns
        writer.write(answer[1000:2000])
        await eventually(lambda: connection.late_since_ns > before_ns)

    assert talk(script, is_outgoing=True).refused == []


def test_packets_that_wait_for_their_turn_are_not_slow() -> None:
    """The last one is not whole yet, which is our doing: we do not read."""

    async def script(reader, writer, taker):
        count = ams_connection.MAX_REQUESTS
        writer.write(ask(b"x") * 3 * count)
        await eventually(lambda: len(taker.waiting) == count)
        await settle()
        assert taker.connection.late_since_ns is None
        for _ in range(3 * count):
            await eventually(lambda: taker.waiting)
            taker.answer()
            await hear(reader)

    assert talk(script, patience_s=0.1, is_slow=True).refused == []


def test_connection_is_closed_when_client_stops_reading() -> None:
    async def script(reader, writer, taker):
        reader._limit = 1  # so that it stops reading
        for _ in range(2000):
            writer.write(ask(bytes(16 << 10)))
            try:
                await asyncio.wait_for(writer.drain(), 0.5)
            except (TimeoutError, OSError):
                return
        raise AssertionError("everything was taken")

    assert talk(script, patience_s=0.1).refused == [DropReason.AMS_SLOW]


def test_notifications_do_not_pile_up() -> None:
    packet = aoe.packet(TARGET, 8, bytes(60_000))

    async def script(reader, writer, taker):
        reader._limit = 1
        sent = 0
        while not taker.closed.is_set():
            taker.connection.send([packet])
            sent += len(packet)
            await asyncio.sleep(0)
        # The buffers of both kernels hold some as well.
        assert sent < ams_connection.MAX_UNSENT + (16 << 20)

    assert talk(script).refused == [DropReason.AMS_SLOW]


def test_client_that_breaks_off_costs_nothing() -> None:
    async def script(reader, writer, taker):
        writer.write(ask() + ask()[:20])
        await eventually(lambda: taker.waiting)
        sock = writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.transport.abort()
        await taker.closed.wait()
        assert taker.connection.send(taker.waiting) == "the connection was closed"

    assert talk(script, is_slow=True).refused == []


def test_half_closed_connection_is_still_answered() -> None:
    async def script(reader, writer, taker):
        writer.write(ask(b"last") + ask(b"one"))
        writer.write_eof()
        await eventually(lambda: len(taker.waiting) == 2)
        taker.answer()
        taker.answer()
        assert (await hear(reader))[2] == b"last"
        assert (await hear(reader))[2] == b"one"
        assert await reader.read() == b""

    assert talk(script, is_slow=True).why == "closed by the peer"


def test_half_closed_client_that_does_not_read_is_disconnected() -> None:
    async def script(reader, writer, taker):
        reader._limit = 1
        writer.write(ask(bytes(100_000)) * 8)
        writer.write_eof()
        await eventually(lambda: taker.seen)
        await taker.closed.wait()

    assert talk(script, patience_s=0.1, grows=20).refused in ([], [DropReason.AMS_SLOW])


def test_dead_peers_are_looked_for() -> None:
    with socket.socket() as sock:
        set_stream_options(sock)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        idle, each, count = (
            sock.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        )
        assert idle + count * each == 60
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 60_000
