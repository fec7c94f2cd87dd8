"""Page: CPU of its server with 50 browsers that show 200 values, and the engine beside it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import aiohttp
import msgspec

from tools.bench import machine
from tools.bench.appliance import running, status
from tools.bench.figures import Figure, at_least, at_most, report
from tools.bench.machine import ProcessSample
from tools.bench.pacing import wait
from tools.bench.plants import many_values
from tools.bench.settings import Settings

TITLE = "page: 50 browsers, 200 values of one page ten times a second"
BROWSERS, VALUES = 50, 200
_CYCLE_US = 10_000
_PORT = 8137
_RATE = 10.0
_WARM_UP_S = 3.0
_MEGA = 1 << 20


class ServedRun(msgspec.Struct, frozen=True):
    """One run of the plant, with browsers or without.

    Attributes:
        engine: Share of a core of the engine.
        services: The same of services.
        web: The same of the page's server.
        rss: Bytes of the page's server.
        lateness_us: Of the station.
        messages: Messages that each browser got a second, the fewest.
    """

    engine: float
    services: float
    web: float
    rss: int
    lateness_us: dict[str, int]
    messages: float = 0.0


def run(settings: Settings) -> list[Figure]:
    """Measure the page's server with and without browsers."""
    machine.require_cores()
    with TemporaryDirectory() as folder:
        plant = Path(folder, "values.yaml")
        described = msgspec.json.decode(many_values(VALUES, _CYCLE_US), type=dict[str, Any])
        described["web"] = {"listen": f"127.0.0.1:{_PORT}"}
        plant.write_bytes(msgspec.json.encode(described))
        settings.tell(f"a page without browsers for {settings.solar_s:.0f} s, and with {BROWSERS}")
        alone = _observe(plant, settings.solar_s, 0)
        shown = _observe(plant, settings.solar_s, BROWSERS)
    late = " · ".join(
        ", ".join(f"{key} {value} µs" for key, value in each.lateness_us.items())
        for each in (alone, shown)
    )
    return [
        at_most("server, share of one core", shown.web * 100, 50, " %"),
        at_least("messages a second of the slowest browser", shown.messages, 0.9 * _RATE),
        report("server without browsers, share of one core", f"{alone.web:.1%}"),
        report("resident memory of the server", f"{shown.rss / _MEGA:.0f} MB"),
        report("services without and with browsers", f"{alone.services:.1%}, {shown.services:.1%}"),
        report("engine without and with browsers", f"{alone.engine:.1%}, {shown.engine:.1%}"),
        report("lateness of the station without · with", late),
    ]


def _observe(plant: Path, seconds: float, browsers: int) -> ServedRun:
    with running(plant, None) as environment:
        wait(_WARM_UP_S)
        before_status = status(None, environment)["processes"]
        pids = [int(before_status[name]["pid"]) for name in ("engine", "services", "web")]
        station = status(None, environment)["stations"][0]["name"]
        samples: list[list[ProcessSample]] = []

        def sample() -> None:
            samples.append([ProcessSample(pid) for pid in pids])

        messages = asyncio.run(_browse(browsers, station, seconds, sample))
        after = status(None, environment)["stations"][0]
    first, last = samples
    shares = [(b.cpu_ns - a.cpu_ns) / seconds / 1e9 for a, b in zip(first, last, strict=True)]
    return ServedRun(
        engine=shares[0],
        services=shares[1],
        web=shares[2],
        rss=last[2].rss,
        lateness_us=dict(after["lateness_us"]),
        messages=messages,
    )


async def _browse(browsers: int, station: str, seconds: float, sample: Callable[[], None]) -> float:
    """Read values as so many browsers; return the messages a second that the slowest one got.

    *sample* is called when all read, and when the time is over.
    """
    counts = [0] * browsers
    async with (
        aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session,
        asyncio.TaskGroup() as group,
    ):
        tasks = [
            group.create_task(_read(session, station, counts, number)) for number in range(browsers)
        ]
        while not all(counts):  # noqa: ASYNC110  an event for each of them would not be simpler
            await asyncio.sleep(0.05)
        before = list(counts)
        sample()
        await asyncio.sleep(seconds)
        sample()
        got = [last - first for last, first in zip(counts, before, strict=True)]
        for task in tasks:
            task.cancel()
    return min(got, default=0) / seconds


async def _read(
    session: aiohttp.ClientSession, station: str, counts: list[int], number: int
) -> None:
    url = f"http://127.0.0.1:{_PORT}/api/v1/ws"
    async with session.ws_connect(url, compress=0, max_msg_size=0) as socket:
        await socket.send_json({"subscribe": [f"values:{station}/value*"]})
        async for message in socket:
            counts[number] += b'"type":"values"' in message.data.encode()[:40]
