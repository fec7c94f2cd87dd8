"""The AMS/TCP listener of an address."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Sequence

import pytest

from eap.net.limits import ListenerLimits
from eap.runtime.drop_counters import DropReason
from eap.services.transports import accepting
from eap.services.transports import ams_tcp as ams_door
from eap.services.transports.accepting import Listeners
from eap.services.transports.ams_tcp import AmsClients, AmsTransport
from eap.services.transports.demultiplexer import Demultiplexer
from tests.support import aoe
from tests.support.amsstation import EchoStation
from tests.support.eventually import eventually

pytestmark = pytest.mark.net

TARGETS = ("1.1.1.1.2.1", "1.1.1.2.2.1")


def question(body: bytes, target: str = TARGETS[0], **more: int) -> bytes:
    packet = aoe.packet(target, aoe.READ_STATE, body, **more)
    return struct.pack("<HI", 0, len(packet)) + packet


async def hear(reader) -> bytes:
    """Return the data of the next answer."""
    _, length = struct.unpack("<HI", await reader.readexactly(6))
    return (await reader.readexactly(length))[32:]


def play(
    script, *, patience_s: float = 5, stations: Sequence[EchoStation] = ()
) -> tuple[list[DropReason], list[EchoStation]]:
    """Run ``script(connect, transport)`` while a transport serves stations, by default two."""
    refused: list[DropReason] = []
    there = list(stations) or [EchoStation(target) for target in TARGETS]

    async def run():
        with socket.create_server(("127.0.0.1", 0)) as listener:
            clients = AmsClients()
            demultiplexer = Demultiplexer([(station, "ams-tcp") for station in there])
            listeners = Listeners(int(patience_s * 1e9))
            transport = AmsTransport(listener, demultiplexer, clients, refused.append, listeners)
            transport.address, transport.listeners = listener.getsockname(), listeners
            for station in there:
                station.send = clients.send
            serving = [asyncio.ensure_future(each.serve()) for each in (transport, listeners)]

            async def connect():
                return await asyncio.open_connection(*listener.getsockname())

            await asyncio.wait_for(script(connect, transport), 10)
            for task in serving:
                task.cancel()
            await asyncio.wait(serving)
            assert all(task.cancelled() for task in serving)
            await eventually(lambda: not clients)

    asyncio.run(run())
    return refused, there


def test_answer_returns_on_the_connection_of_its_request():
    """All clients look alike: the same NetID, port and numbers of requests."""

    async def client(connect, name):
        reader, writer = await connect()
        for number in range(50):
            body = f"{name} {number}".encode()
            writer.write(question(body, TARGETS[number % 2]))
            assert await hear(reader) == body
        writer.close()

    async def script(connect, transport):
        await asyncio.gather(*(client(connect, name) for name in range(20)))

    refused, stations = play(script)
    assert refused == []
    for station in stations:
        names = {connection for _, _, connection in station.seen}
        assert {connection for _, connection in station.closed} >= names
        assert len(names) == 20


def test_packet_is_for_the_station_that_has_its_target_else_for_one_with_a_route():
    stations = [
        EchoStation(TARGETS[0]),
        EchoStation(TARGETS[1], routes=["7.7.7.7.1.1", TARGETS[0]]),
        EchoStation(routes=["7.7.7.7.1.1"]),
    ]

    async def script(connect, transport):
        reader, writer = await connect()
        for target in (*TARGETS, "7.7.7.7.1.1", "8.8.8.8.1.1"):
            writer.write(question(target.encode(), target))
            await hear(reader)
        writer.close()

    play(script, stations=stations)
    seen = [[data[32:].decode() for data, *_ in station.seen] for station in stations]
    assert seen == [[TARGETS[0], "8.8.8.8.1.1"], [TARGETS[1], "7.7.7.7.1.1"], []]


def test_names_of_connections_do_not_come_again():
    async def script(connect, transport):
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        for _ in range(3):  # from the same port, even
            with socket.socket() as sock:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                sock.setblocking(False)
                sock.bind(("127.0.0.1", port))
                loop = asyncio.get_running_loop()
                await loop.sock_connect(sock, transport.address)
                await loop.sock_sendall(sock, question(b"x"))
                assert await loop.sock_recv(sock, 100)

    _, stations = play(script)
    names = [connection for _, _, connection in stations[0].seen]
    assert len(set(names)) == 3
    assert len({name.partition("#")[0] for name in names}) == 1
    assert {transport for _, transport, _ in stations[0].seen} == {"ams-tcp"}
    assert {name.partition(":")[0] for name in names} == {"127.0.0.1"}


def test_client_with_many_requests_does_not_delay_others():
    async def script(connect, transport):
        greedy, writer = await connect()
        reader, other = await connect()
        writer.write(question(b"greedy") * 500)
        other.write(question(b"other"))
        assert await hear(reader) == b"other"
        for _ in range(500):
            assert await hear(greedy) == b"greedy"
        writer.close()
        other.close()

    refused, stations = play(script)
    served = [data[32:] for data, *_ in stations[0].seen]
    assert refused == []
    assert len(served) == 501
    assert served.index(b"other") < 250


def test_client_that_dies_leaves_the_others_alone():
    async def script(connect, transport):
        reader, writer = await connect()
        for _ in range(20):
            _, dying = await connect()
            dying.write(question(b"x") * 3 + question(b"y")[:20])
            dying.get_extra_info("socket").setsockopt(
                socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
            )
            dying.transport.abort()
            writer.write(question(b"alive"))
            assert await hear(reader) == b"alive"
        writer.close()

    assert play(script)[0] == []


def test_silent_connections_make_room_for_others(monkeypatch):
    monkeypatch.setattr(accepting, "host_of", lambda peer, own: "10.0.0.1")
    monkeypatch.setattr(ams_door, "LIMITS", ListenerLimits(total=3, reserved=0))

    async def script(connect, transport):
        async def ask(reader, writer):
            writer.write(question(b"x"))
            return await hear(reader)

        clients = [await connect() for _ in range(3)]
        *used, silent = clients
        assert [await ask(*each) for each in used] == [b"x", b"x"]
        clients.append(newcomer := await connect())
        assert await silent[0].read() == b""
        assert [await ask(*each) for each in (*used, newcomer)] == [b"x"] * 3
        clients.append(refused := await connect())
        assert await refused[0].read() == b""
        used[0][1].close()
        await eventually(lambda: transport.listeners.stats()[0].open == 2)
        clients.append(late := await connect())
        assert await ask(*late) == b"x"
        (stats,) = transport.listeners.stats()
        assert (stats.open, stats.limit, stats.refused, stats.evicted) == (3, 3, 1, 1)
        for _, writer in clients:
            writer.close()

    assert play(script)[0] == [DropReason.AMS_FULL]


def test_client_that_breaks_the_rules_is_disconnected():
    async def script(connect, transport):
        for octets in (b"\2\0" + bytes(4), question(b"x")[:10]):
            reader, writer = await connect()
            writer.write(octets)
            assert await reader.read() == b""
            writer.close()

    assert play(script, patience_s=0.1)[0] == [DropReason.AMS_TYPE, DropReason.AMS_SLOW]


def test_unsolicited_answers_are_counted():
    async def script(connect, transport):
        reader, writer = await connect()
        writer.write(question(b"x", flags=5) + question(b"y"))
        assert await hear(reader) == b"y"
        writer.close()

    refused, stations = play(script)
    assert refused == [DropReason.AMS_UNASKED]
    assert len(stations[0].seen) == 1


def test_send_on_closed_connection_fails():
    assert AmsClients().send("127.0.0.1:1#1", (b"",)) == "the connection was closed"


def test_connection_that_is_reset_before_it_is_accepted_is_no_matter():
    async def script(connect, transport):
        for _ in range(5):
            with socket.socket() as sock:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                sock.connect(transport.address)
        reader, writer = await connect()
        writer.write(question(b"x"))
        assert await hear(reader) == b"x"
        writer.close()

    assert play(script)[0] == []


def test_connection_that_cannot_be_served_gives_its_place_back(monkeypatch):
    def refuse(sock):
        raise OSError(22, "Invalid argument")

    async def script(connect, transport):
        with monkeypatch.context() as patch:
            patch.setattr(ams_door, "set_stream_options", refuse)
            reader, writer = await connect()
            assert await reader.read() == b""
            writer.close()
        assert transport.listeners.stats()[0].open == 0
        reader, writer = await connect()
        writer.write(question(b"x"))
        assert await hear(reader) == b"x"
        writer.close()

    play(script)


def test_connections_are_closed_with_the_listener():
    async def script(connect, transport):
        client.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(client, transport.address)
        await loop.sock_sendall(client, question(b"x"))
        assert await loop.sock_recv(client, 100)

    with socket.socket() as client:
        _, stations = play(script)
        assert stations[0].closed == [("ams-tcp", stations[0].seen[0][2])]
        assert client.recv(1) == b""
