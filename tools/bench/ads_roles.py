"""ADS clients and servers, each a process: pyads, its test server, and plain sockets."""

from __future__ import annotations

import asyncio
import selectors
import socket
import struct
from contextlib import ExitStack
from time import perf_counter_ns
from typing import Any

from tools.bench.pacing import answer, wait

PORT = 48898
DEVICE = 0xFFFF
SDO, OBJECT = 0xF302, 0x1000 << 16
_BATCH = 100
"""Requests between two looks at the clock."""
_AMS = struct.Struct("<6sH6sHHHIII")
_READ = struct.Struct("<III")
_ERROR_AT = 6 + 24
_SKIPPED = 50
"""Round trips left out: they find cold caches."""


def pyads_reads(job: dict[str, Any]) -> None:
    """Read 4 octets again and again; tell how many reads a second there were."""
    import pyads

    reads = 0
    with pyads.Connection(job["net_id"], DEVICE, job["address"]) as client:
        for _ in range(_BATCH):
            client.read(SDO, OBJECT, pyads.PLCTYPE_UDINT)
        begin_ns = perf_counter_ns()
        end_ns = begin_ns + int(job["seconds"] * 1e9)
        while perf_counter_ns() < end_ns:
            for _ in range(_BATCH):
                client.read(SDO, OBJECT, pyads.PLCTYPE_UDINT)
            reads += _BATCH
        took_ns = perf_counter_ns() - begin_ns
    answer({"per_second": reads / took_ns * 1e9})


def pyads_server(job: dict[str, Any]) -> None:
    """Run the test server that comes with pyads, until this process is killed."""
    from pyads.testserver import AdsTestServer, BasicHandler

    with AdsTestServer(handler=BasicHandler(), ip_address=job["address"], logging=False):
        answer({"ready": True})
        wait(3600)


def reads(job: dict[str, Any]) -> None:
    """Read 4 octets again and again by a plain socket; tell each round trip in nanoseconds."""
    request = _request(job["net_id"], job.get("port", DEVICE))
    with socket.create_connection((job["address"], PORT)) as sock:
        trips = _trips(sock, request, int(job["count"]))
        if request_failed(trips.last):
            raise RuntimeError(f"{job['net_id']} answers with {trips.last.hex()}")
    answer({"trips": trips.taken[_SKIPPED:]})


def echoes(job: dict[str, Any]) -> None:
    """Send as many octets to an echo; tell each round trip in nanoseconds."""
    with socket.create_connection((job["address"], job["port"])) as sock:
        trips = _trips(sock, _request("1.1.1.1.1.1"), int(job["count"]))
    answer({"trips": trips.taken[_SKIPPED:]})


def echo(job: dict[str, Any]) -> None:
    """Send back what comes by one TCP connection after the other, until this process is killed."""
    with socket.create_server((job["address"], 0)) as listener:
        answer({"port": listener.getsockname()[1]})
        while True:
            sock, _ = listener.accept()
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with sock:
                while octets := sock.recv(65536):
                    sock.sendall(octets)


def asyncio_echo(job: dict[str, Any]) -> None:
    """Do as :func:`echo`, by the least that asyncio takes."""
    asyncio.run(_asyncio_echo(job["address"]))


class _Echo(asyncio.BufferedProtocol):
    octets = memoryview(bytearray(65536))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def get_buffer(self, sizehint: int) -> memoryview:
        return self.octets

    def buffer_updated(self, nbytes: int) -> None:
        self.transport.write(bytes(self.octets[:nbytes]))  # type: ignore[attr-defined]


async def _asyncio_echo(address: str) -> None:
    server = await asyncio.get_running_loop().create_server(_Echo, address, 0)
    answer({"port": server.sockets[0].getsockname()[1]})
    await server.serve_forever()


def crowd(job: dict[str, Any]) -> None:
    """Read by a connection for each of *ports* at once, again after each answer; tell the counts.

    All are served by one selector, which takes turns.
    """
    requests = [_request(job["net_id"], port) for port in job["ports"]]
    counts = [0] * len(requests)
    with ExitStack() as stack:
        selector = stack.enter_context(selectors.DefaultSelector())
        socks = [
            stack.enter_context(socket.create_connection((job["address"], PORT))) for _ in counts
        ]
        for number, sock in enumerate(socks):
            selector.register(sock, selectors.EVENT_READ, number)
            sock.sendall(requests[number])
        end_ns = perf_counter_ns() + int(job["seconds"] * 1e9)
        while perf_counter_ns() < end_ns:
            for key, _ in selector.select(1):
                sock = socks[key.data]
                if request_failed(sock.recv(4096)):
                    raise RuntimeError("a request failed")
                counts[key.data] += 1
                sock.sendall(requests[key.data])
    answer({"counts": counts})


class _Trips:
    def __init__(self) -> None:
        self.taken: list[int] = []
        self.last = b""


def _trips(sock: socket.socket, request: bytes, count: int) -> _Trips:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.settimeout(10)
    trips = _Trips()
    for _ in range(count + _SKIPPED):
        begin_ns = perf_counter_ns()
        sock.sendall(request)
        trips.last = sock.recv(65536)
        trips.taken.append(perf_counter_ns() - begin_ns)
    return trips


def request_failed(octets: bytes) -> bool:
    """Return whether an answer is invalid or has an error in its AMS header."""
    return len(octets) <= _ERROR_AT or octets[_ERROR_AT : _ERROR_AT + 4] != bytes(4)


def _request(net_id: str, port: int = DEVICE) -> bytes:
    """Return a request for 4 octets of a dictionary, with the prefix of AMS/TCP."""
    target = bytes(int(part) for part in net_id.split("."))
    body = _READ.pack(SDO, OBJECT, 4)
    source = bytes((127, 0, 0, 1, 1, 1))
    ams = _AMS.pack(target, port, source, 40000, 2, 4, len(body), 0, 1) + body
    return struct.pack("<HI", 0, len(ams)) + ams
