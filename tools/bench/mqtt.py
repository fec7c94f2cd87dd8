"""Values by MQTT: CPU of the bridge that publishes 200 values ten times a second."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from tools.bench import machine
from tools.bench.appliance import running, status
from tools.bench.figures import Figure, at_least, at_most, report
from tools.bench.machine import ProcessSample
from tools.bench.pacing import wait
from tools.bench.plants import many_values
from tools.bench.settings import Settings

TITLE = "values by MQTT: 200 values ten times a second"
VALUES, RATE = 200, 10.0
_CYCLE_US = 10_000
_PORT = 18_837
_WARM_UP_S = 3.0
_MEGA = 1 << 20
_SEARCH = "/usr/local/sbin:/usr/sbin:/sbin:/usr/bin:/bin"


class PublishedRun(msgspec.Struct, frozen=True):
    """One run of the plant.

    Attributes:
        bridge: Share of a core of the bridge.
        services: The same of services.
        engine: The same of the engine.
        rss: Bytes of the bridge.
        values: Messages that reached a client of the broker a second.
        dropped: Values that newer ones replaced before they were sent.
    """

    bridge: float
    services: float
    engine: float
    rss: int
    values: float
    dropped: int


def run(settings: Settings) -> list[Figure]:
    """Measure the bridge with JSON on topics, and with Sparkplug B."""
    machine.require_cores()
    program = shutil.which("mosquitto", path=_SEARCH)
    if program is None or shutil.which("mosquitto_sub") is None:
        return [report("values by MQTT", "mosquitto or mosquitto_sub is missing")]
    settings.tell(f"values by MQTT as JSON and by Sparkplug B, {settings.solar_s:.0f} s each")
    with TemporaryDirectory() as folder, _broker(program, Path(folder)):
        as_json = _observe(Path(folder), settings.solar_s, {"json": True})
        sparkplug = _observe(Path(folder), settings.solar_s, {"json": False, "sparkplug": "bench"})
    return [
        at_most(
            "bridge with JSON on 200 topics, share of one core", as_json.bridge * 100, 60, " %"
        ),
        at_least("messages of JSON a second", as_json.values, 0.9 * VALUES * RATE),
        at_most("bridge with Sparkplug B, share of one core", sparkplug.bridge * 100, 20, " %"),
        at_least("messages of Sparkplug B a second", sparkplug.values, 0.9 * RATE),
        report("resident memory of the bridge", f"{as_json.rss / _MEGA:.0f} MB"),
        report(
            "services with JSON and Sparkplug B",
            f"{as_json.services:.1%}, {sparkplug.services:.1%}",
        ),
        report("engine with JSON and Sparkplug B", f"{as_json.engine:.1%}, {sparkplug.engine:.1%}"),
    ]


@contextmanager
def _broker(program: str, folder: Path) -> Iterator[None]:
    config = folder / "mosquitto.conf"
    config.write_text(f"listener {_PORT} 127.0.0.1\nallow_anonymous true\nuser root\n")
    process = subprocess.Popen([program, "-c", str(config)], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


def _observe(folder: Path, seconds: float, keys: dict[str, Any]) -> PublishedRun:
    plant = folder / "values.yaml"
    described = msgspec.json.decode(many_values(VALUES, _CYCLE_US), type=dict[str, Any])
    described["mqtt"] = {"broker": f"mqtt://127.0.0.1:{_PORT}"} | keys
    plant.write_bytes(msgspec.json.encode(described))
    with running(plant, None) as environment:
        wait(_WARM_UP_S)
        processes = status(None, environment)["processes"]
        pids = [int(processes[name]["pid"]) for name in ("mqtt", "services", "engine")]
        first = [ProcessSample(pid) for pid in pids]
        count = _count(seconds)
        last = [ProcessSample(pid) for pid in pids]
        dropped = status(None, environment)["processes"]["mqtt"]["bridge"]["dropped"]
    bridge, services, engine = (
        (b.cpu_ns - a.cpu_ns) / seconds / 1e9 for a, b in zip(first, last, strict=True)
    )
    rss = last[0].rss
    return PublishedRun(bridge, services, engine, rss, count / seconds, int(dropped))


def _count(seconds: float) -> int:
    """Return the number of live messages that a client of the broker gets."""
    words = ["-h", "127.0.0.1", "-p", str(_PORT), "-t", "#", "-F", "%r", "-W", f"{seconds:.0f}"]
    done = subprocess.run(["mosquitto_sub", *words], capture_output=True, text=True, check=False)
    return done.stdout.count("0")
