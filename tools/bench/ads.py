"""ADS by AMS/TCP: reads beside pyads' own server, what each hop adds, and a crowd of clients."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import msgspec

from tools.bench import machine
from tools.bench.appliance import running, status
from tools.bench.figures import Figure, at_least, at_most, median_ratio, report, skipped
from tools.bench.network import Worker
from tools.bench.settings import Settings

TITLE = "ADS by AMS/TCP: 4 octets of a dictionary, read by pyads and by plain sockets over loopback"
NEAR, FAR, SERVER = "127.0.9.31", "127.0.9.32", "127.0.9.33"
CLIENTS = 100
OURS, THEIRS = "ads_roles.pyads_reads", "ads_roles.pyads_server"
HOPS = {"type 5 over UDP": "", "AMS/TCP": "ams_tcp: far/eap0"}
"""What the route to the far station says."""


def run(settings: Settings) -> list[Figure]:
    """Measure all of it; raise SkippedError without a second core."""
    machine.require_cores()
    with TemporaryDirectory(dir=machine.memory_folder()) as name:
        folder = Path(name)
        return [
            _reads(settings, folder),
            *(figure for how in HOPS for figure in _hop(settings, folder, how)),
            _crowd(settings, folder),
        ]


def reads_figure(pairs: Sequence[tuple[float, float]]) -> Figure:
    """Compare reads a second, ours and the server's of pyads, of the same rounds."""
    ours, theirs = (median(side) for side in zip(*pairs, strict=True))
    detail = f"{ours / 1000:.1f} to {theirs / 1000:.1f} thousand/s"
    name = "reads by pyads: of pyads' own test server"
    return at_least(name, median_ratio(pairs), 0.8, detail)


class Trips(NamedTuple):
    """Medians of one round in nanoseconds."""

    hop: float
    """Of reads through a station."""
    direct: float
    """Of reads from that station itself."""
    raw: float
    """Of as many octets to an echo, a loop over a blocking socket."""
    looped: float
    """The same to the smallest echo that asyncio makes."""


def hop_figures(how: str, rounds: Sequence[Trips]) -> list[Figure]:
    """Say what a hop adds."""
    hop, direct, raw, looped = (median(column) / 1000 for column in zip(*rounds, strict=True))
    added = median((each.hop - each.direct) / each.raw for each in rounds)
    in_loops = median((each.hop - each.direct) / each.looped for each in rounds)
    detail = f"{direct:.0f} to {hop:.0f} µs, an echo {raw:.0f} µs"
    name = f"a hop by {how} adds, in round trips of"
    return [
        at_most(f"{name} a raw echo", added, 2, "", detail),
        report(f"{name} the smallest asyncio echo", f"{in_loops:.2f} ({looped:.0f} µs)", in_loops),
    ]


def crowd_figure(counts: Sequence[int], seconds: float) -> Figure:
    """Compare the client with the fewest answers with the one in the middle."""
    middle = median(counts)
    detail = f"{min(counts)} to {middle:.0f} reads, {sum(counts) / seconds / 1000:.1f} thousand/s"
    name = f"{len(counts)} clients at once: the slowest, of the median"
    return at_least(name, min(counts) / middle if middle else 0, 0.5, detail)


def _reads(settings: Settings, folder: Path) -> Figure:
    if importlib.util.find_spec("pyads") is None:
        return skipped("reads by pyads", "needs pyads")
    near, far = machine.cores()
    pairs = []
    server = {"address": SERVER}
    with _appliance(folder, "near", far), _worker(THEIRS, server, far) as serving:
        serving.answer()
        for number in range(settings.rounds):
            settings.tell(f"ADS reads, round {number + 1} of {settings.rounds}")
            order = (NEAR, SERVER) if number % 2 else (SERVER, NEAR)
            found = {}
            for address in order:
                job = {"address": address, "net_id": f"{address}.2.1"}
                with _worker(OURS, job | {"seconds": settings.throughput_s}, near) as client:
                    found[address] = client.answer()["per_second"]
            pairs.append((found[NEAR], found[SERVER]))
    return reads_figure(pairs)


def _hop(settings: Settings, folder: Path, how: str) -> list[Figure]:
    near, far = machine.cores()
    rounds = []
    count = {"count": 400 * settings.rounds}
    with ExitStack() as stack:
        stack.enter_context(_appliance(folder, "near", far, HOPS[how]))
        stack.enter_context(_appliance(folder, "far", near))
        echoes = [
            {
                "address": SERVER,
                **stack.enter_context(_worker(role, {"address": SERVER}, far)).answer(),
            }
            for role in ("ads_roles.echo", "ads_roles.asyncio_echo")
        ]
        for number in range(settings.rounds):
            settings.tell(f"a hop by {how}, round {number + 1} of {settings.rounds}")
            jobs = [
                ("reads", {"address": NEAR, "net_id": f"{FAR}.2.1"}),
                ("reads", {"address": NEAR, "net_id": f"{NEAR}.2.1"}),
                *(("echoes", echo) for echo in echoes),
            ]
            found = []
            for role, job in jobs:
                with _worker(f"ads_roles.{role}", job | count, near) as client:
                    found.append(median(client.answer()["trips"]))
            rounds.append(Trips(*found))
    return hop_figures(how, rounds)


def _crowd(settings: Settings, folder: Path) -> Figure:
    near, far = machine.cores()
    settings.tell(f"{CLIENTS} clients at once")
    seconds = settings.latency_s
    job = {"address": NEAR, "net_id": f"{NEAR}.2.1", "clients": CLIENTS, "seconds": seconds}
    with (
        _appliance(folder, "near", far),
        _worker("ads_roles.crowd", job, near) as clients,
    ):
        return crowd_figure(clients.answer(seconds)["counts"], seconds)


@contextmanager
def _appliance(folder: Path, station: str, cpu: int, route: str = "") -> Iterator[None]:
    """Run one of two stations that know each other; its services are on one core."""
    path = folder / f"{station}.yaml"
    path.write_text(plant(route), encoding="utf-8")
    with running(path, None, "--station", station) as environment:
        services = status(None, environment)["processes"]["services"]["pid"]
        os.sched_setaffinity(services, {cpu})
        yield


def plant(route: str) -> str:
    """Return a plant of two stations; *route* is how the near one reaches the far one."""
    return f"""\
plant: ads
defaults: {{cycle_us: 10000}}
stations:
  - name: near
    net_id: {NEAR}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{NEAR}", net_id: {NEAR}.2.1}}
    routes: [{f"{{to: far, {route}}}" if route else ""}]
  - name: far
    net_id: {FAR}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{FAR}", net_id: {FAR}.2.1}}
"""


@contextmanager
def _worker(role: str, job: dict[str, Any], cpu: int) -> Iterator[Worker]:
    text = msgspec.json.encode(job | {"cpu": cpu}).decode()
    worker = Worker([sys.executable, "-m", "tools.bench.worker", role, text])
    try:
        yield worker
    finally:
        worker.close()
