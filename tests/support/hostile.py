"""A hostile host as a program: many connections of every bad kind to each listener, until killed.

``python -m tests.support.hostile JSON`` with an object of: ``address``, ``ams`` and ``frames`` (TCP
ports), ``control`` (paths of control sockets), ``count`` (connections of each kind to each
listener) and ``pause_s`` (before a connection that was closed is made again).
"""

from __future__ import annotations

import asyncio
import json
import random
import socket
import struct
import sys
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import NamedTuple

from tests.support import aoe
from tests.support.vectors import load

AMS_UDP, FRAMES_UDP = 48899, 34980
(ADD_ROUTE, _) = (vector.octets for vector in load("ams_discovery"))


class Listener(NamedTuple):
    """A target of connections, with requests that it answers and the start of one."""

    connect: Callable[[], Awaitable[socket.socket]]
    request: bytes
    start: bytes


def _ams_request(target: str) -> bytes:
    packet = aoe.packet(target, aoe.READ, aoe.read_body(0x10000000))
    return struct.pack("<HI", 0, len(packet)) + packet


async def _connect_tcp(address: str, port: int) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, (address, port))
    return sock


async def _connect_unix(path: str) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, path)
    return sock


async def _until_closed(sock: socket.socket) -> None:
    while await asyncio.get_running_loop().sock_recv(sock, 4096):
        pass


async def be_silent(listener: Listener, sock: socket.socket) -> None:
    """Say nothing."""
    await _until_closed(sock)


async def leave_unfinished(listener: Listener, sock: socket.socket) -> None:
    """Begin a request and never end it."""
    await asyncio.get_running_loop().sock_sendall(sock, listener.start)
    await _until_closed(sock)


async def send_garbage(listener: Listener, sock: socket.socket) -> None:
    """Send what is no request."""
    await asyncio.get_running_loop().sock_sendall(sock, random.randbytes(64))
    await _until_closed(sock)


async def never_read(listener: Listener, sock: socket.socket) -> None:
    """Send requests without end, and read no answer."""
    loop = asyncio.get_running_loop()
    while True:
        await loop.sock_sendall(sock, 2 * listener.request)
        await asyncio.sleep(0.5)


async def come_and_go(listener: Listener, sock: socket.socket) -> None:
    """Leave at once, every other time with a reset."""
    if random.random() < 0.5:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


async def send_process_data(listener: Listener, sock: socket.socket) -> None:
    """Keep one of the places for process data, with frames that nobody subscribed to."""
    loop = asyncio.get_running_loop()
    while True:
        await loop.sock_sendall(sock, b"\x08\x40" + bytes(8))
        await asyncio.sleep(1)


KINDS = (be_silent, leave_unfinished, send_garbage, never_read, come_and_go)


async def _attack(
    listener: Listener,
    behave: Callable[[Listener, socket.socket], Awaitable[None]],
    pause_s: float,
) -> None:
    while True:
        await asyncio.sleep(pause_s * random.uniform(0.2, 1.8))
        try:
            sock = await listener.connect()
        except OSError:
            continue
        try:
            await behave(listener, sock)
        except OSError:
            pass
        finally:
            sock.close()


async def _send_datagrams(address: str, port: int, make: Callable[[], bytes]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setblocking(False)
        sock.connect((address, port))
        while True:
            await asyncio.sleep(random.uniform(0.2, 1.8))
            try:
                sock.send(make())
            except OSError:
                continue


def _frame_garbage() -> bytes:
    return random.choice((random.randbytes(64), b"\x3a\x50" + random.randbytes(58)))


def _listeners(task: dict) -> Iterator[Listener]:
    address = task["address"]
    target = f"{address}.2.1"
    frame = aoe.frame(aoe.packet(target, aoe.READ, aoe.read_body(0x10000000)))
    mailbox = struct.pack("<HHHBB", 6 | 5 << 12, 0, 0, 0, 0x13)
    for port in task["ams"]:
        ams = _ams_request(target)
        yield Listener(partial(_connect_tcp, address, port), ams, ams[:10])
    for port in task["frames"]:
        request = frame if port == FRAMES_UDP else mailbox
        yield Listener(partial(_connect_tcp, address, port), request, frame[:1])
    for path in task["control"]:
        line = b'{"v":1,"id":1,"method":"status"}\n'
        yield Listener(partial(_connect_unix, path), line, line[:8])


async def main(task: dict) -> None:
    """Attack as *task* says."""
    address, pause_s = task["address"], task["pause_s"]
    data = Listener(partial(_connect_tcp, address, FRAMES_UDP), b"", b"")
    async with asyncio.TaskGroup() as group:
        for _ in range(task["count"]):
            for listener in _listeners(task):
                for kind in KINDS:
                    group.create_task(_attack(listener, kind, pause_s))
            if task["ams"]:
                group.create_task(_attack(data, send_process_data, pause_s))
                group.create_task(_send_datagrams(address, AMS_UDP, lambda: ADD_ROUTE))
                group.create_task(_send_datagrams(address, FRAMES_UDP, _frame_garbage))


if __name__ == "__main__":
    asyncio.run(main(json.loads(sys.argv[1])))
