"""A whole appliance under measurement: ``eapctl run`` in a namespace, read by ``status``."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from eap.runtime.folder import VARIABLE
from eap.runtime.store import VARIABLE as STATE_VARIABLE
from tools.bench.figures import Bar, BarKind, Figure, at_most
from tools.bench.machine import ProcessSample, memory_folder
from tools.bench.network import ROOT, Cable
from tools.bench.pacing import wait

PROCESSES = ("supervisor", "engine", "services")
_READY_WITHIN_S = 60.0
_END_WITHIN_S = 10.0
WINDOWS = 5
"""Parts of an observation that processor time is counted in."""
_WARM_UP_S = 2.0
_EAPCTL = (sys.executable, "-m", "eap")


class Observation(msgspec.Struct, frozen=True):
    """Counters of an appliance over *seconds*.

    Attributes:
        cpu: Share of one core of each process, in the median of WINDOWS; those of segments are
            named after their buses.
        rss: Octets of each process, likewise.
        lost: Frames lost, over all subscriptions.
        received: PDs received, likewise.
        overruns: Cycles left out because the engine came too late.
        cycles: Cycles due, of all stations.
        lateness_us: That of the station that was worst.
    """

    seconds: float
    cpu: dict[str, float]
    rss: dict[str, int]
    lost: int
    received: int
    overruns: int
    cycles: int
    lateness_us: dict[str, int]


@contextmanager
def running(plant: Path, link: Cable | None, *arguments: str) -> Iterator[dict[str, str]]:
    """Run *plant* until the block ends; yield the environment in which ``eapctl`` finds it.

    Args:
        plant: Its file.
        link: Where it runs; None for here.
        arguments: Of ``eapctl run``, behind the plant.

    Raises:
        RuntimeError: it does not get ready.
    """
    with TemporaryDirectory(dir=memory_folder()) as folder:
        runtime = Path(folder, "run")
        runtime.mkdir()
        environment = os.environ | {VARIABLE: str(runtime), STATE_VARIABLE: f"{folder}/state"}
        process = subprocess.Popen(
            command_in(link, "run", str(plant), *arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            cwd=ROOT,
        )
        try:
            output = process.stdout
            assert output is not None  # noqa: S101  it was asked for
            fired, _, _ = select.select([output], [], [], _READY_WITHIN_S)
            if not fired or b'"ready"' not in output.readline():
                raise RuntimeError(f"eapctl run {plant.name} does not get ready")
            yield environment
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_END_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def observe(plant: Path, seconds: float, link: Cable | None) -> Observation:
    """Run *plant* for *seconds* and return what it did."""
    with running(plant, link) as environment:
        wait(_WARM_UP_S)
        first = status(link, environment)
        pids = _pids(first["processes"])
        samples = []
        for number in range(WINDOWS + 1):
            samples.append({name: ProcessSample(pid) for name, pid in pids.items()})
            if number < WINDOWS:
                wait(seconds / WINDOWS)
        last = status(link, environment)
    cpu = {name: _share([each[name] for each in samples], seconds) for name in pids}
    return Observation(
        seconds=seconds,
        cpu=cpu,
        rss={name: samples[-1][name].rss for name in pids},
        lost=sum(pd["lost"] or 0 for station in last["stations"] for pd in station["pd"]["rx"]),
        received=sum(pd["received"] for station in last["stations"] for pd in station["pd"]["rx"]),
        overruns=sum(s["overruns"] for s in last["stations"]),
        cycles=sum(s["cycle"] for s in last["stations"]),
        lateness_us={
            key: max(station["lateness_us"][key] for station in last["stations"])
            for key in ("p50", "p99", "max")
        },
    )


def _share(samples: Sequence[ProcessSample], seconds: float) -> float:
    """Return the share of a core in the median window, so that one burst does not decide."""
    windows = [after.cpu_ns - before.cpu_ns for before, after in pairwise(samples)]
    return median(windows) * WINDOWS / seconds / 1e9


def share_figure(
    title: str, seen: Observation, process: str, target: float, floor: tuple[str, float | None]
) -> Figure:
    """Return the share of a core of one process in percent.

    Args:
        title: Name of plant and process.
        seen: Observation of the plant.
        process: Name of the process there.
        target: Largest share.
        floor: Name of a loop that does the least with the same cycle, and its share of a core;
            None where it could not run.
    """
    share = seen.cpu[process] * 100
    bars = [Bar("ours", share, BarKind.OURS)]
    name, least = floor
    if least is not None:
        bars.append(Bar(name, least * 100, BarKind.LIMIT))
    limit = f"{name}, not measured" if least is None else f"{name}: {least * 100:.1f} %"
    figure = at_most(f"{title}, share of one core", share, target, " %", limit=limit)
    return figure.compared(title, "%", bars, target)


def _pids(processes: dict[str, Any]) -> dict[str, int]:
    segments = processes.get("segments", {})
    single = {name: each for name, each in processes.items() if "pid" in each}
    return {name: int(each["pid"]) for name, each in (single | segments).items()}


def status(link: Cable | None, environment: dict[str, str]) -> dict[str, Any]:
    """Return what ``eapctl status`` says of the appliance that runs in *environment*."""
    done = subprocess.run(
        command_in(link, "status", "--json"),
        capture_output=True,
        check=True,
        env=environment,
        cwd=ROOT,
    )
    return msgspec.json.decode(done.stdout, type=dict[str, Any])


def command_in(link: Cable | None, *words: str) -> Sequence[str]:
    """Return the command line of ``eapctl`` with *words*, run in *link* if given."""
    command = [*_EAPCTL, *words]
    return link.command(0, *command) if link else command
