"""The line of the EAP article: fifteen stations in one appliance, and what they cost."""

from __future__ import annotations

from contextlib import nullcontext
from os import geteuid
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from tools.bench import machine, rawloop
from tools.bench.appliance import PROCESSES, observe, share_figure
from tools.bench.figures import Figure, at_most, report
from tools.bench.network import ROOT, Cable, Page, cable
from tools.bench.plants import line
from tools.bench.settings import Settings
from tools.bench.stations import Shape

TITLE = "solar-line: 15 stations, 54 PDs of 600 and 1024 bytes, every 10 ms, one engine process"
ISLANDS, CYCLE_US = 14, 10_000
"""Of the plant that is delivered."""
PLANT = ROOT / "config" / "solar-line.yaml"
_MEGA = 1 << 20


def run(settings: Settings) -> list[Figure]:
    """Run the plant that is delivered; as root in a namespace of its own."""
    machine.require_cores()
    settings.tell(f"solar-line for {settings.solar_s:.0f} s, with generated values and without")
    with (
        cable() if geteuid() == 0 else nullcontext() as link,
        TemporaryDirectory(dir=machine.memory_folder()) as folder,
    ):
        seen = observe(PLANT, settings.solar_s, link)
        path = Path(folder, "still.yaml")
        path.write_bytes(line(ISLANDS, CYCLE_US, generated=False))
        still = observe(path, settings.solar_s, link)
        least = _loop(link, settings.latency_s) if link and rawloop.is_possible() else None
    loop = ("the C loop", least)
    memory = ", ".join(f"{name} {seen.rss[name] / _MEGA:.0f} MB" for name in PROCESSES)
    share = ", ".join(f"{name} {seen.cpu[name]:.1%}" for name in PROCESSES[::2])
    late = ", ".join(f"{key} {value} µs" for key, value in seen.lateness_us.items())
    return [
        at_most("frames lost", seen.lost, 0, " ", f"of {seen.received} received"),
        share_figure("solar line: engine", seen, "engine", 8, loop),
        share_figure("solar line without generated values: engine", still, "engine", 5, loop),
        at_most("engine, resident memory", seen.rss["engine"] / _MEGA, 60, " MB"),
        report("resident memory of each process", memory),
        report("the other processes, share of one core", share),
        report("lateness of the worst station", late),
        report("cycles left out", f"{seen.overruns} of {seen.cycles}", seen.overruns),
    ]


def _loop(link: Cable, seconds: float) -> float:
    """Return the share of a core of the loop in C that sends and receives the same frames."""
    path = link.folder / "page"
    Page(path)
    job = {
        "page": str(path),
        "interface": link.interface(0),
        "seconds": seconds,
        "shape": msgspec.structs.asdict(Shape(1, 1, 600)),
    }
    with rawloop.raw_loop(link, "line", job, side=0, cpu=machine.cores()[0]) as worker:
        worker.answer()
        return float(worker.answer(seconds)["cpu"])
