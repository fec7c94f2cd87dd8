"""Clients and servers of asyncua and python-snap7, each a process."""

from __future__ import annotations

import asyncio
import logging
from time import perf_counter_ns
from typing import Any

from tools.bench.pacing import answer, wait

_WARM_UP = 50
_BATCH = 20
"""Requests between two looks at the clock."""
_BLOCK = 1


def opcua_server(job: dict[str, Any]) -> None:
    """Run the server of asyncua with as many numbers as the plant has."""
    asyncio.run(_opcua_server(job))


async def _opcua_server(job: dict[str, Any]) -> None:
    from asyncua import Server, ua

    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://{job['address']}:{job['port']}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    await server.register_namespace("urn:bench")
    for number in range(job["values"]):
        # Every node has the name that the client reads; the first one is that of the plant.
        name = job["node"].replace("value000", f"value{number:03}")
        await server.nodes.objects.add_variable(ua.NodeId.from_string(name), name, 1.5)
    async with server:
        answer({"ready": True})
        await asyncio.Event().wait()


def opcua_reads(job: dict[str, Any]) -> None:
    """Read a value again and again by the client of asyncua; tell how many a second."""
    answer({"per_second": asyncio.run(_opcua_reads(job))})


async def _opcua_reads(job: dict[str, Any]) -> float:
    from asyncua import Client

    logging.disable(logging.WARNING)
    async with Client(f"opc.tcp://{job['address']}:{job['port']}", timeout=30) as client:
        node = client.get_node(job["node"])
        for _ in range(_WARM_UP):
            await node.read_value()
        reads, begin_ns = 0, perf_counter_ns()
        end_ns = begin_ns + int(job["seconds"] * 1e9)
        while (now_ns := perf_counter_ns()) < end_ns:
            for _ in range(_BATCH):
                await node.read_value()
            reads += _BATCH
    return reads / (now_ns - begin_ns) * 1e9


def s7_server(job: dict[str, Any]) -> None:
    """Run the server of snap7 with a data block as large as that of the plant."""
    from snap7.server import Server
    from snap7.type import SrvArea

    logging.disable(logging.WARNING)
    server = Server()
    server.register_area(SrvArea.DB, _BLOCK, bytearray(8 * job["values"]))
    server.start_to(job["address"], job["port"])
    answer({"ready": True})
    wait(3600)


def s7_reads(job: dict[str, Any]) -> None:
    """Read the block again and again by the client of snap7; tell how many a second."""
    from snap7.client import Client

    client = Client()
    client.connect(job["address"], 0, 1, job["port"])
    size = 8 * job["values"]
    for _ in range(_WARM_UP):
        client.db_read(_BLOCK, 0, size)
    reads, begin_ns = 0, perf_counter_ns()
    end_ns = begin_ns + int(job["seconds"] * 1e9)
    while (now_ns := perf_counter_ns()) < end_ns:
        for _ in range(_BATCH):
            client.db_read(_BLOCK, 0, size)
        reads += _BATCH
    client.disconnect()
    answer({"per_second": reads / (now_ns - begin_ns) * 1e9})
