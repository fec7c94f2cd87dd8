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

from tools.bench import buses, machine
from tools.bench.ads_roles import DEVICE
from tools.bench.appliance import running, status
from tools.bench.figures import (
    Bar,
    BarKind,
    Figure,
    at_least,
    at_most,
    median_ratio,
    report,
    skipped,
)
from tools.bench.gateway_roles import PORT as GATEWAY_PORT
from tools.bench.network import Worker
from tools.bench.pacing import wait
from tools.bench.settings import Settings

TITLE = "ADS by AMS/TCP: 4 bytes of a dictionary, read by pyads and by plain sockets over loopback"
NEAR, FAR, SERVER = "127.0.9.31", "127.0.9.32", "127.0.9.33"
CLIENTS = 100
SLAVES = list(range(1001, 1017))
_GATEWAY: dict[str, Any] = {"address": NEAR, "port": GATEWAY_PORT}
_UP_WITHIN_S = 30
OURS, THEIRS = "ads_roles.pyads_reads", "ads_roles.pyads_server"
HOPS = {"type 5 over UDP": ("", 3.0), "AMS/TCP": ("ams_tcp: far/eap0", 2.5)}
"""Hop of the route to the remote station, and the most that it may add."""


def run(settings: Settings) -> list[Figure]:
    """Measure all of it; raise SkippedError without a second core."""
    machine.require_cores()
    with TemporaryDirectory(dir=machine.memory_folder()) as name:
        folder = Path(name)
        return [
            _reads(settings, folder),
            *(figure for how in HOPS for figure in _hop(settings, folder, how)),
            _crowd(settings, folder),
            *_slaves(settings, folder),
        ]


def reads_figure(pairs: Sequence[tuple[float, float]]) -> Figure:
    """Compare reads a second, ours and the server's of pyads, of the same rounds."""
    ours, theirs = (median(side) for side in zip(*pairs, strict=True))
    detail = f"{ours / 1000:.1f} to {theirs / 1000:.1f} thousand/s"
    name = "reads by pyads: of pyads' own test server"
    figure = at_least(
        name,
        median_ratio(pairs),
        1.1,
        detail,
        limit=f"its own server: {theirs / 1000:.1f} thousand/s",
    )
    bars = [
        Bar("ours", ours / 1000, BarKind.OURS),
        Bar("pyads' test server", theirs / 1000, BarKind.PEER),
    ]
    return figure.compared("ADS by pyads: 4 bytes", "thousand/s", bars, 1.1 * theirs / 1000)


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


def hop_figures(how: str, target: float, rounds: Sequence[Trips]) -> list[Figure]:
    """Say what a hop adds."""
    hop, direct, raw, looped = (median(column) / 1000 for column in zip(*rounds, strict=True))
    added = median((each.hop - each.direct) / each.raw for each in rounds)
    in_loops = median((each.hop - each.direct) / each.looped for each in rounds)
    detail = f"{direct:.0f} to {hop:.0f} µs, an echo {raw:.0f} µs"
    name = f"a hop by {how} adds, in round trips of"
    return [
        at_most(f"{name} a raw echo", added, target, "", detail,
                limit=f"the smallest asyncio echo is {looped / raw:.2f} of one"),
        report(f"{name} the smallest asyncio echo", f"{in_loops:.2f} ({looped:.0f} µs)", in_loops),
    ]  # fmt: skip


def crowd_figure(counts: Sequence[int], seconds: float) -> Figure:
    """Compare the client with the fewest answers with the one in the middle."""
    middle = median(counts)
    detail = f"{min(counts)} to {middle:.0f} reads, {sum(counts) / seconds / 1000:.1f} thousand/s"
    name = f"{len(counts)} clients at once: the slowest, of the median"
    return at_least(name, min(counts) / middle if middle else 0, 0.5, detail)


class SlaveReads(NamedTuple):
    """One round: reads a second of all slaves at once, and the median trip of one in µs."""

    ads: float
    gateway: float
    ads_us: float
    gateway_us: float


def slave_figures(rounds: Sequence[SlaveReads]) -> list[Figure]:
    """Compare reads of slaves by ADS with those by the mailbox gateway."""
    ads, gateway, ads_us, gateway_us = (median(column) for column in zip(*rounds, strict=True))
    ratio = median_ratio([(each.ads, each.gateway) for each in rounds])
    longer = median_ratio([(each.ads_us, each.gateway_us) for each in rounds])
    name = f"{len(SLAVES)} slaves read at once: of reads by the mailbox gateway"
    detail = f"{ads:.0f} to {gateway:.0f} reads/s"
    one = "a slave read alone: time, ratio to the mailbox gateway"
    return [
        at_least(name, ratio, 0.8, detail),
        at_most(one, longer, 1.2, "", f"{ads_us:.0f} to {gateway_us:.0f} µs"),
    ]


def _slaves(settings: Settings, folder: Path) -> list[Figure]:
    """Read the slaves of a plant of its own by AMS/TCP and by the gateway, in turn."""
    near, far = machine.cores()
    (folder / "bus.yaml").write_bytes(buses.encode(buses.bus(len(SLAVES), 512)))
    path = folder / "slaves.yaml"
    path.write_text(slave_plant(), encoding="utf-8")
    rounds = []
    seconds, count = settings.latency_s, 100 * settings.rounds
    with running(path, None) as environment:
        os.sched_setaffinity(status(None, environment)["processes"]["services"]["pid"], {far})
        _wait_up(environment)
        for number in range(settings.rounds):
            settings.tell(f"slaves by ADS, round {number + 1} of {settings.rounds}")
            ads: dict[str, Any] = {"address": NEAR, "net_id": f"{NEAR}.3.1"}
            jobs: list[tuple[str, dict[str, Any]]] = [
                ("ads_roles.crowd", ads | {"ports": SLAVES, "seconds": seconds}),
                ("gateway_roles.crowd", _GATEWAY | {"stations": SLAVES, "seconds": seconds}),
                ("ads_roles.reads", ads | {"port": SLAVES[0], "count": count}),
                ("gateway_roles.reads", _GATEWAY | {"station": SLAVES[0], "seconds": seconds}),
            ]
            found = []
            for role, job in jobs:
                with _worker(role, job, near) as client:
                    answer = client.answer(seconds)
                    found.append(client.answer(seconds) if "ready" in answer else answer)
            both = [sum(each["counts"]) / seconds for each in found[:2]]
            one = [median(each["trips"]) / 1000 for each in found[2:]]
            rounds.append(SlaveReads(*both, *one))
    return slave_figures(rounds)


def _wait_up(environment: dict[str, str]) -> None:
    """Wait until all slaves are in OP; raise RuntimeError if they do not get there."""
    for _ in range(_UP_WITHIN_S):
        wait(1.0)
        (station,) = status(None, environment)["stations"]
        bus = next(port["bus"] for port in station["ports"] if "bus" in port)
        if [slave["state"] for slave in bus.get("slaves", [])] == ["OP"] * len(SLAVES):
            return
    raise RuntimeError(f"the bus of the plant does not come up: {bus}")


def slave_plant() -> str:
    """Return a plant of one station with a simulated bus."""
    return f"""\
plant: slaves
defaults: {{cycle_us: 2000}}
stations:
  - name: near
    net_id: {NEAR}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{NEAR}", net_id: {NEAR}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://bus.yaml", net_id: {NEAR}.3.1}}
"""


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
    route, target = HOPS[how]
    count = {"count": 400 * settings.rounds}
    with ExitStack() as stack:
        stack.enter_context(_appliance(folder, "near", far, route))
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
    return hop_figures(how, target, rounds)


def _crowd(settings: Settings, folder: Path) -> Figure:
    near, far = machine.cores()
    settings.tell(f"{CLIENTS} clients at once")
    seconds = settings.latency_s
    ports = [DEVICE] * CLIENTS
    job = {"address": NEAR, "net_id": f"{NEAR}.2.1", "ports": ports, "seconds": seconds}
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
