"""The mailbox gateway: reads beside a bare UDP echo, a crowd, a file, and the engine meanwhile."""

from __future__ import annotations

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
from tools.bench.figures import Bar, BarKind, Figure, at_least, at_most, median_ratio, report
from tools.bench.gateway_roles import PORT
from tools.bench.network import ROOT, Worker
from tools.bench.pacing import wait
from tools.bench.settings import Settings

TITLE = "Mailbox gateway: 4 bytes of a dictionary read by plain sockets over loopback"
GATEWAY, ECHO = "127.0.9.51", "127.0.9.52"
CYCLE_US = 2000
CLIENTS = 32
FILE_SIZE = 1_000_000
MASTER, SLAVE = 0, 1001
_DRIVE = ROOT / "config" / "buses" / "drive.yaml"
_UP_WITHIN_S = 30


def run(settings: Settings) -> list[Figure]:
    """Measure all of it; raise SkippedError without a second core."""
    machine.require_cores()
    with TemporaryDirectory(dir=machine.memory_folder()) as name:
        path = Path(name) / "gateway.yaml"
        path.write_text(plant(), encoding="utf-8")
        with _appliance(path) as environment:
            rounds = _rounds(settings)
            found = [*read_figures(rounds), _crowd(settings), *_files(settings)]
            del environment
        late = {asked: _lateness(settings, path, asked) for asked in ("nobody", "echo", "gateway")}
    return [*found, *late_figures(**late)]


class Round(NamedTuple):
    """Reads of one round, a second; and the median round trips in microseconds."""

    echo: float
    master: float
    master_us: float
    slave_us: float


def read_figures(rounds: Sequence[Round]) -> list[Figure]:
    """Compare reads of the master with the echo, and of a slave with those of the master."""
    echo, master, master_us, slave_us = (median(column) for column in zip(*rounds, strict=True))
    ratio = median_ratio([(each.master, each.echo) for each in rounds])
    detail = f"{master / 1000:.1f} to {echo / 1000:.1f} thousand/s"
    added = median(each.slave_us - each.master_us for each in rounds) / CYCLE_US
    slow = f"{slave_us:.0f} µs, of the master {master_us:.0f} µs, cycle {CYCLE_US} µs"
    limit = f"echo by a loop in Python: {echo / 1000:.1f} thousand/s"
    name = "gateway: reads of the master's dictionary, of a bare UDP echo"
    bars = [
        Bar("ours", master / 1000, BarKind.OURS),
        Bar("a bare UDP echo", echo / 1000, BarKind.LIMIT),
    ]
    title = "mailbox gateway by UDP: 4 bytes of the master"
    reads = at_least(name, ratio, 0.6, detail, limit=limit)
    return [
        reads.compared(title, "thousand/s", bars, 0.6 * echo / 1000),
        at_most("a read of a slave takes longer than of the master, by cycles", added, 2, "", slow),
    ]


def crowd_figure(counts: Sequence[int], seconds: float) -> Figure:
    """Compare the client with the fewest answers with the one with the most."""
    most = max(counts)
    detail = f"{min(counts)} to {most} reads, {sum(counts) / seconds / 1000:.1f} thousand/s"
    name = f"{len(counts)} clients at once: the slowest, of the quickest"
    return at_least(name, min(counts) / most if most else 0, 0.5, detail)


def file_figures(way: str, rounds: Sequence[dict[str, float]]) -> list[Figure]:
    """Say how fast a file goes both ways, by UDP or TCP."""
    rates = {
        step: median(FILE_SIZE / each[step] / 1e6 for each in rounds)
        for step in ("stored", "fetched")
    }
    return [
        report(f"1 MB {step} by FoE over {way}", f"{rate:.2f} MB/s", rate)
        for step, rate in rates.items()
    ]


def late_figures(
    nobody: dict[str, int], echo: dict[str, int], gateway: dict[str, int]
) -> list[Figure]:
    """Compare the lateness of cycles with clients at the gateway, at a bare echo, and without any.

    What the echo adds, a machine adds that has no idle core any more, whoever keeps it busy.
    """
    name = f"lateness of the engine, {{}}: {CLIENTS} clients at the gateway, of those at an echo"
    detail = "{}, {} µs; {} µs without clients"
    figures = [
        at_most(
            name.format(key),
            gateway[key] / max(echo[key], 1),
            1.3,
            "",
            detail.format(gateway[key], echo[key], nobody[key]),
        )
        for key in ("p50", "p99")
    ]
    longest = f"{gateway['max']}, {echo['max']} and {nobody['max']} µs"
    return [
        *figures,
        report("the same, max: gateway, echo and no clients", longest, gateway["max"]),
    ]


def plant() -> str:
    """Return a plant of one station with one slave."""
    return f"""\
plant: gateway
defaults: {{cycle_us: {CYCLE_US}}}
stations:
  - name: bench
    net_id: {GATEWAY}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{GATEWAY}", net_id: {GATEWAY}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://{_DRIVE}", net_id: {GATEWAY}.3.1}}
"""


def _rounds(settings: Settings) -> list[Round]:
    near, far = machine.cores()
    seconds = settings.throughput_s
    with _worker("echo", {"address": ECHO}, far) as echoing:
        port = echoing.answer()["port"]
        jobs = [(ECHO, port, MASTER), (GATEWAY, PORT, MASTER), (GATEWAY, PORT, SLAVE)]
        rounds = []
        for number in range(settings.rounds):
            settings.tell(f"gateway reads, round {number + 1} of {settings.rounds}")
            found = []
            for address, to, station in jobs:
                job = {"address": address, "port": to, "station": station, "seconds": seconds}
                with _worker("reads", job, near) as client:
                    found.append(client.answer(seconds))
            echo, master, slave = found
            trips = [median(each["trips"]) / 1000 for each in (master, slave)]
            rounds.append(Round(echo["per_second"], master["per_second"], *trips))
    return rounds


def _crowd(settings: Settings) -> Figure:
    settings.tell(f"{CLIENTS} clients of a gateway at once")
    seconds = settings.latency_s
    with _clients(GATEWAY, PORT, seconds) as clients:
        return crowd_figure(clients.answer(seconds)["counts"], seconds)


@contextmanager
def _clients(address: str, port: int, seconds: float) -> Iterator[Worker]:
    job = {"address": address, "port": port, "stations": [MASTER] * CLIENTS, "seconds": seconds}
    with _worker("crowd", job, machine.cores()[0]) as clients:
        clients.answer()
        yield clients


def _files(settings: Settings) -> list[Figure]:
    figures = []
    for way in ("UDP", "TCP"):
        rounds = []
        for number in range(settings.rounds):
            settings.tell(f"a file over {way}, round {number + 1} of {settings.rounds}")
            job = {"address": GATEWAY, "station": SLAVE, "size": FILE_SIZE, "tcp": way == "TCP"}
            with _worker("transfer", job, machine.cores()[0]) as client:
                rounds.append(client.answer(30.0))
        figures += file_figures(way, rounds)
    return figures


def _lateness(settings: Settings, path: Path, asked: str) -> dict[str, int]:
    """Run a plant of its own, for figures go from its start on; return how late its cycles were."""
    settings.tell(f"the engine while {CLIENTS} clients ask: {asked}")
    seconds = settings.lateness_s
    with ExitStack() as stack:
        environment = stack.enter_context(_appliance(path))
        if asked == "nobody":
            wait(seconds)
        else:
            address, port = GATEWAY, PORT
            if asked == "echo":  # where services have their core too
                job = {"address": ECHO}
                echo = stack.enter_context(_worker("echo", job, machine.cores()[1]))
                address, port = ECHO, echo.answer()["port"]
            clients = stack.enter_context(_clients(address, port, seconds))
            clients.answer(seconds)
        (station,) = status(None, environment)["stations"]
        return dict(station["lateness_us"])


@contextmanager
def _appliance(path: Path) -> Iterator[dict[str, str]]:
    """Run the plant, its services on one core, until the bus is up."""
    with running(path, None) as environment:
        services = status(None, environment)["processes"]["services"]["pid"]
        os.sched_setaffinity(services, {machine.cores()[1]})
        _wait_up(environment)
        yield environment


def _wait_up(environment: dict[str, str]) -> None:
    """Wait until the slave is in OP; raise RuntimeError if it does not get there."""
    for _ in range(_UP_WITHIN_S):
        wait(1.0)
        (station,) = status(None, environment)["stations"]
        bus = next(port["bus"] for port in station["ports"] if "bus" in port)
        if [slave["state"] for slave in bus.get("slaves", [])] == ["OP"]:
            return
    raise RuntimeError(f"the bus of the plant does not come up: {bus}")


@contextmanager
def _worker(role: str, job: dict[str, Any], cpu: int) -> Iterator[Worker]:
    text = msgspec.json.encode(job | {"cpu": cpu}).decode()
    command = [sys.executable, "-m", "tools.bench.worker", f"gateway_roles.{role}", text]
    worker = Worker(command)
    try:
        yield worker
    finally:
        worker.close()
