"""OPC UA: CPU of the server with 500 doubles ten times a second, alone and with one subscriber."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
from asyncua import Client

from tools.bench import machine
from tools.bench.appliance import running, status
from tools.bench.figures import Figure, at_least, at_most, report
from tools.bench.machine import ProcessSample
from tools.bench.pacing import wait
from tools.bench.plants import many_values
from tools.bench.settings import Settings

TITLE = "OPC UA: 500 variables ten times a second, one client that subscribes to all"
VALUES = 500
_CYCLE_US = 10_000
_PORT = 8138
_RATE = 10.0
_START_S = 60.0
_PUBLISH_MS = 100
_MEGA = 1 << 20
_NAMES = ("opcua", "services", "engine")


class SubscribedRun(msgspec.Struct, frozen=True):
    """One run of the plant: shares of a core by process, and changes that the client got.

    Attributes:
        shares: Share of a core of each process.
        rss: Bytes of the server.
        rate: Changes of a variable a second, of the slowest one; 0 without a client.
    """

    shares: dict[str, float]
    rss: int
    rate: float


class _Counts:
    """Handler of the subscription: changes by node."""

    def __init__(self) -> None:
        self.by_node: dict[str, int] = {}

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        name = node.nodeid.Identifier
        self.by_node[name] = self.by_node.get(name, 0) + 1


def run(settings: Settings) -> list[Figure]:
    """Measure the server without and with a client."""
    machine.require_cores()
    with TemporaryDirectory() as folder:
        plant = Path(folder, "values.yaml")
        described = msgspec.json.decode(many_values(VALUES, _CYCLE_US), type=dict[str, Any])
        described["opcua"] = {"listen": f"127.0.0.1:{_PORT}"}
        plant.write_bytes(msgspec.json.encode(described))
        settings.tell(f"{VALUES} variables for {settings.solar_s:.0f} s, and with a subscriber")
        alone = _observe(plant, settings.solar_s, subscribes=False)
        shown = _observe(plant, settings.solar_s, subscribes=True)
    return [
        at_most("server without clients, share of one core", alone.shares["opcua"] * 100, 10, " %"),
        at_most("server with the subscriber", shown.shares["opcua"] * 100, 60, " %"),
        at_least("changes a second of the slowest variable", shown.rate, 0.9 * _RATE),
        report("resident memory of the server", f"{shown.rss / _MEGA:.0f} MB"),
        *(
            report(
                f"{name} without and with the subscriber",
                f"{alone.shares[name]:.1%}, {shown.shares[name]:.1%}",
            )
            for name in ("services", "engine")
        ),
    ]


def _observe(plant: Path, seconds: float, *, subscribes: bool) -> SubscribedRun:
    with running(plant, None) as environment:
        processes = status(None, environment)["processes"]
        for _ in range(int(_START_S)):
            if processes["opcua"].get("bridge", {}).get("is_up"):
                break
            wait(1.0)
            processes = status(None, environment)["processes"]
        wait(3.0)
        pids = [int(processes[name]["pid"]) for name in _NAMES]
        samples: list[list[ProcessSample]] = []

        def sample() -> None:
            samples.append([ProcessSample(pid) for pid in pids])

        if subscribes:
            station = status(None, environment)["stations"][0]["name"]
            rate = asyncio.run(_subscribe(station, seconds, sample))
        else:
            rate = 0.0
            sample()
            wait(seconds)
            sample()
    first, last = samples
    shares = [(b.cpu_ns - a.cpu_ns) / seconds / 1e9 for a, b in zip(first, last, strict=True)]
    return SubscribedRun(dict(zip(_NAMES, shares, strict=True)), last[0].rss, rate)


async def _subscribe(station: str, seconds: float, sample: Callable[[], None]) -> float:
    """Subscribe to all variables; return the changes a second of the slowest one."""
    counts = _Counts()
    # The client gives up a server that does not answer within the interval of its watchdog.
    url = f"opc.tcp://127.0.0.1:{_PORT}"
    async with Client(url, timeout=60, watchdog_intervall=60) as client:
        names = await client.get_node(f"ns=2;s={station}").get_variables()
        nodes = [each for each in names if "/value" in each.nodeid.Identifier]
        subscription = await client.create_subscription(_PUBLISH_MS, counts)
        await subscription.subscribe_data_change(nodes)
        await asyncio.sleep(1.0)
        before = dict(counts.by_node)
        sample()
        await asyncio.sleep(seconds)
        sample()
        got = [counts.by_node[name] - number for name, number in before.items()]
    return min(got) / seconds if len(got) == len(nodes) == VALUES else 0.0
