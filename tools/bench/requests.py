"""Requests by OPC UA and S7: our bridges beside the servers of the libraries, the same client."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec

from tools.bench import machine
from tools.bench.appliance import running, status
from tools.bench.figures import Bar, BarKind, Figure, median_ratio, report, skipped
from tools.bench.network import Worker
from tools.bench.pacing import wait
from tools.bench.plants import many_values
from tools.bench.settings import Settings

TITLE = (
    "Requests by OPC UA and S7: our bridges beside the servers of the libraries, the same client"
)
VALUES = 25
_CYCLE_US = 10_000
_STATION = "values"
_OURS, _THEIRS = "127.0.9.61", "127.0.9.62"
_UP_WITHIN_S = 60


class Protocol(NamedTuple):
    """A bridge, the library whose client reads from it, and the roles of the library."""

    name: str
    bridge: str
    package: tuple[str, str]
    what: str
    port: int
    keys: dict[str, Any]
    server: str
    client: str
    node: str = ""


PROTOCOLS = (
    Protocol(
        "OPC UA",
        "opcua",
        ("asyncua", "asyncua"),
        "a value",
        8139,
        {"listen": f"{_OURS}:8139"},
        "request_roles.opcua_server",
        "request_roles.opcua_reads",
        f"ns=2;s={_STATION}/value000",
    ),
    Protocol(
        "S7",
        "s7",
        ("python-snap7", "snap7"),
        f"{8 * VALUES} bytes of a data block",
        8140,
        {
            "server": {
                "listen": f"{_OURS}:8140",
                "blocks": {1: [f"{_STATION}/value{number:03}" for number in range(VALUES)]},
            }
        },
        "request_roles.s7_server",
        "request_roles.s7_reads",
    ),
)


def run(settings: Settings) -> list[Figure]:
    """Measure both protocols; raise SkippedError without a second core."""
    machine.require_cores()
    figures = []
    for protocol in PROTOCOLS:
        name, module = protocol.package
        if importlib.util.find_spec(module) is None:
            figures.append(skipped(f"reads by {protocol.name}", f"needs {name}"))
            continue
        figures.append(figure_of(protocol, _measure(settings, protocol)))
    return figures


def figure_of(protocol: Protocol, pairs: Sequence[tuple[float, float]]) -> Figure:
    """Compare reads a second, of our bridge and of the library's server in the same rounds."""
    ours, theirs = (median(side) / 1000 for side in zip(*pairs, strict=True))
    ratio = median_ratio(pairs)
    name = f"reads by {protocol.name} of {protocol.what}: of the server of {protocol.package[0]}"
    detail = f"{ours:.2f} to {theirs:.2f} thousand/s"
    bars = [Bar("ours", ours, BarKind.OURS), Bar(protocol.package[0], theirs, BarKind.PEER)]
    figure = report(name, f"{ratio:.2f} ({detail})", ratio)
    return figure.compared(f"{protocol.name}: {protocol.what}", "thousand/s", bars)


def plant(protocol: Protocol) -> bytes:
    """Return a plant of one station whose values the bridge of *protocol* serves."""
    described = msgspec.json.decode(many_values(VALUES, _CYCLE_US), type=dict[str, Any])
    return msgspec.json.encode(described | {protocol.bridge: protocol.keys})


def _measure(settings: Settings, protocol: Protocol) -> list[tuple[float, float]]:
    near, far = machine.cores()
    pairs = []
    job = {"port": protocol.port, "values": VALUES, "node": protocol.node}
    with TemporaryDirectory(dir=machine.memory_folder()) as folder:
        path = Path(folder, "values.yaml")
        path.write_bytes(plant(protocol))
        with (
            _bridge(path, protocol, far),
            _worker(protocol.server, job | {"address": _THEIRS}, far) as serving,
        ):
            serving.answer()
            for number in range(settings.rounds):
                settings.tell(f"reads by {protocol.name}, round {number + 1} of {settings.rounds}")
                found = {}
                for address in (_OURS, _THEIRS)[:: -1 if number % 2 else 1]:
                    more = job | {"address": address, "seconds": settings.throughput_s}
                    with _worker(protocol.client, more, near) as client:
                        found[address] = client.answer()["per_second"]
                pairs.append((found[_OURS], found[_THEIRS]))
    return pairs


@contextmanager
def _bridge(path: Path, protocol: Protocol, cpu: int) -> Iterator[None]:
    """Run the plant, its bridge on one core, until the bridge serves."""
    with running(path, None) as environment:
        for _ in range(_UP_WITHIN_S):
            process = status(None, environment)["processes"][protocol.bridge]
            if process.get("bridge", {}).get("is_up"):
                break
            wait(1.0)
        else:
            raise RuntimeError(f"the bridge does not come up: {process}")
        os.sched_setaffinity(int(process["pid"]), {cpu})
        yield


@contextmanager
def _worker(role: str, job: dict[str, Any], cpu: int) -> Iterator[Worker]:
    text = msgspec.json.encode(job | {"cpu": cpu}).decode()
    worker = Worker([sys.executable, "-m", "tools.bench.worker", role, text])
    try:
        yield worker
    finally:
        worker.close()
