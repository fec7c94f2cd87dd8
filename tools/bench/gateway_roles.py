"""Clients of a mailbox gateway, each a process: plain sockets, and ours for a file."""

from __future__ import annotations

import os
import selectors
import socket
from time import perf_counter_ns
from typing import Any

from tools.bench.pacing import answer, wait

PORT = 34980
_UPLOAD = bytes.fromhex("10500a000000002300204018100100000000")
_ADDRESS = slice(4, 6)
_ABORT_AT, _ABORT = 10, 0x80
_LARGEST = 2048
_ANSWER_S = 2.0
_COLD = 50
"""Round trips left out: they find cold caches."""


def request(station: int) -> bytes:
    """Return the upload of the vendor of the master, 0, or of a slave."""
    frame = bytearray(_UPLOAD)
    frame[_ADDRESS] = station.to_bytes(2, "little")
    return bytes(frame)


def reads(job: dict[str, Any]) -> None:
    """Send the same and wait for what comes, again and again; tell the round trips."""
    octets = request(job["station"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.connect((job["address"], job["port"]))
        sock.settimeout(_ANSWER_S)
        trips, back = [], b""
        end_ns = perf_counter_ns() + int(job["seconds"] * 1e9)
        while (begin_ns := perf_counter_ns()) < end_ns:
            sock.send(octets)
            back = sock.recv(_LARGEST)
            trips.append(perf_counter_ns() - begin_ns)
    if back[_ABORT_AT] == _ABORT:
        raise RuntimeError(f"{job['address']} answers with {back.hex()}")
    kept = trips[_COLD:] or trips
    answer({"per_second": len(kept) / sum(kept) * 1e9, "trips": kept})


def echo(job: dict[str, Any]) -> None:
    """Send back each datagram, until this process is killed."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((job["address"], 0))
        answer({"port": sock.getsockname()[1]})
        while True:
            octets, client = sock.recvfrom(_LARGEST)
            sock.sendto(octets, client)


def crowd(job: dict[str, Any]) -> None:
    """Be a client for each of *stations*, with one request on its way; tell the answers of each."""
    requests = [request(station) for station in job["stations"]]
    counts = [0] * len(requests)
    with selectors.DefaultSelector() as selector:
        for number, octets in enumerate(requests):
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.connect((job["address"], job["port"]))
            selector.register(sock, selectors.EVENT_READ, number)
            sock.send(octets)
        answer({"ready": True})
        end_ns = perf_counter_ns() + int(job["seconds"] * 1e9)
        while perf_counter_ns() < end_ns:
            for key, _ in selector.select(_ANSWER_S):
                client = key.fileobj
                assert isinstance(client, socket.socket)  # noqa: S101  as registered
                back = client.recv(_LARGEST)
                if back[_ABORT_AT] == _ABORT:
                    raise RuntimeError(f"{job['address']} answers with {back.hex()}")
                counts[key.data] += 1
                client.send(requests[key.data])
        for key in list(selector.get_map().values()):
            assert isinstance(key.fileobj, socket.socket)  # noqa: S101
            key.fileobj.close()
    wait(0.1)
    answer({"counts": counts})


def transfer(job: dict[str, Any]) -> None:
    """Store a file and fetch it; tell the seconds of both."""
    from eap.gateway.client import GatewayClient

    content = os.urandom(job["size"])
    with GatewayClient(job["address"], tcp=job["tcp"]) as client:
        begin_ns = perf_counter_ns()
        client.foe_write(job["station"], "firmware.bin", content)
        stored_ns = perf_counter_ns()
        if client.foe_read(job["station"], "firmware.bin") != content:
            raise RuntimeError("what was fetched is not what was stored")
        fetched_ns = perf_counter_ns()
    answer({"stored": (stored_ns - begin_ns) / 1e9, "fetched": (fetched_ns - stored_ns) / 1e9})
