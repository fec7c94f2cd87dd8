"""The demo plant: time until it is ready, processor time and memory of all its processes."""

from __future__ import annotations

from contextlib import nullcontext
from os import geteuid
from statistics import median
from time import perf_counter

from tools.bench import machine
from tools.bench.appliance import PROCESSES, Observation, observe, running, share_figure
from tools.bench.figures import Figure, at_most, report
from tools.bench.network import ROOT, Cable, cable
from tools.bench.settings import Settings
from tools.bench.startup import imports

TITLE = "Demo plant: 3 stations, 3 buses of simulated slaves, page; 10 ms"
PLANT = ROOT / "config" / "demo.yaml"
CYCLE_US = 10_000
_MEGA = 1 << 20
_OTHERS = "web"
RSS_BEFORE_MB = 105
"""Supervisor, engine and services before the cyclic path was compiled."""


def run(settings: Settings) -> list[Figure]:
    """Start the plant several times, then observe it."""
    machine.require_cores()
    with cable() if geteuid() == 0 else nullcontext() as link:
        ready_s = []
        for number in range(settings.rounds):
            settings.tell(f"start of the demo plant, {number + 1} of {settings.rounds}")
            ready_s.append(_start(link))
        settings.tell(f"demo plant for {settings.solar_s:.0f} s")
        seen = observe(PLANT, settings.solar_s, link)
        woken = _wake(link, settings.latency_s) if link else None
    names = ("supervisor", "engine", "services with buses", "segment", "segment", "segment")
    imports_s = {name: imports(name, settings.rounds)[0] / 1000 for name in set(names)}
    return figures_of(ready_s, sum(imports_s[name] for name in names), seen, woken)


def figures_of(
    ready_s: list[float], imports_s: float, seen: Observation, woken: float | None
) -> list[Figure]:
    """Return the figures of several starts and of one observation.

    Args:
        ready_s: Seconds of each start.
        imports_s: CPU time of the imports of all processes that are ready then.
        seen: The observation.
        woken: Share of a core of a loop in Python that only wakes; None if it did not run.
    """
    floor = ("a loop that only wakes", woken)
    segments = [name for name in seen.cpu if name not in {*PROCESSES, _OTHERS}]
    dearest = max(segments, key=lambda name: seen.cpu[name])
    rss = {name: octets / _MEGA for name, octets in seen.rss.items()}
    own = sum(rss[name] for name in PROCESSES)
    listed = ", ".join(f"{name} {rss[name]:.0f}" for name in rss)
    return [
        at_most("demo: plant ready", median(ready_s), 1.5, " s", f"longest {max(ready_s):.2f} s",
                limit=f"CPU time of its imports: {imports_s:.1f} s"),
        share_figure("demo: engine", seen, "engine", 5, floor),
        share_figure("demo: dearest segment", seen, dearest, 2, floor),
        at_most("demo: resident memory of supervisor, engine and services", own, RSS_BEFORE_MB,
                " MB", limit="before: 105 MB, and the segments"),
        report("demo: resident memory of all processes", f"{sum(rss.values()):.0f} MB ({listed})",
               sum(rss.values())),
    ]  # fmt: skip


def _start(link: Cable | None) -> float:
    """Return seconds from the start of the command to its message that the plant is ready."""
    begin = perf_counter()
    with running(PLANT, link):
        return perf_counter() - begin


def _wake(link: Cable, seconds: float) -> float:
    """Return the share of a core of a process in Python that wakes for each cycle of the plant."""
    job = {"cycle_us": CYCLE_US, "seconds": seconds}
    with link.worker("raw_roles.wake", job, side=0, cpu=machine.cores()[0]) as worker:
        return float(worker.answer(seconds)["cpu"])
