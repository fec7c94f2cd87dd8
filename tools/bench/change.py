"""Cost of a change of a running station: the swap, and the lateness of cycles meanwhile."""

from __future__ import annotations

import gc
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter_ns
from typing import Any, NamedTuple

from eap.engine.channels import PortChannels
from eap.engine.engine_buses import EngineBuses
from eap.engine.rebuild import EngineStation, StationReplacement
from eap.ids import InterfaceUri
from eap.net.image_file import create_image
from eap.net.loopback import LoopbackLines
from eap.pd.engine import Engine
from eap.pd.layout import plan_layout
from eap.pd.station import Station
from eap.runtime.drop_counters import DropCounters
from tools.bench import machine
from tools.bench.change_roles import station
from tools.bench.figures import Figure, at_most, percentile, report
from tools.bench.network import Cable, cable
from tools.bench.settings import Settings

TITLE = "Changing a running station: as many PDs sent as received, one PD more and one less"
PRIORITY = 50
_SWAP_MS = {30: 0.3, 1000: 3.0}
"""Longest swap of that many PDs in each direction."""
_LATENESS_PDS = 30
_ROUNDS = 12


class Change(NamedTuple):
    """One change, in nanoseconds."""

    build: int
    swap: int
    first_cycle: int
    next_cycle: int


def run(settings: Settings) -> list[Figure]:
    """Measure swaps; with root and two cores also how late the cycles of a loop are."""
    figures = []
    for pds, allowed_ms in _SWAP_MS.items():
        settings.tell(f"change of {pds} PDs")
        figures += swap_figures(pds, _swaps(pds), allowed_ms)
    machine.require_cores()
    with cable() as link:
        settings.tell("lateness during changes")
        figures += lateness_figures(_lateness(link, settings.lateness_s))
    return figures


def swap_figures(pds: int, changes: list[Change], allowed_ms: float) -> list[Figure]:
    """Say what the changes of a station of *pds* PDs each way took."""
    build, swap, first, following = (
        median(getattr(change, field) for change in changes) / 1000 for field in Change._fields
    )
    name = f"{pds:,} PDs each way"
    longest = max(change.swap for change in changes) / 1e6
    detail = f"max {longest:.2f} ms; the cycle after it {first:.0f} us, others {following:.0f} us"
    return [
        at_most(f"{name}: swap", swap / 1000, allowed_ms, " ms", detail),
        report(f"{name}: build", f"{build / 1000:.1f} ms", build / 1000),
    ]


def lateness_figures(found: dict[str, Any]) -> list[Figure]:
    """Say how late cycles were while something was built or swapped, and in between."""
    if found["refused"] or found["lost"] or not found["changes"]:
        lost = f"{found['lost']} lost or twice"
        raise RuntimeError(
            f"{found['changes']} changes, {lost}: {found['refused'] or 'none refused'}"
        )
    name = f"{_LATENESS_PDS} PDs each way at 1 ms"
    return [
        report(f"{name}: lateness in between", _tails(found["quiet_ns"])),
        report(
            f"{name}: lateness while changing",
            f"{_tails(found['disturbed_ns'])} ({found['changes']} changes, nothing lost)",
            percentile(found["disturbed_ns"], 0.99) / 1000,
        ),
    ]


def _tails(late_ns: list[int]) -> str:
    shares = ((0.5, "p50"), (0.99, "p99"), (1.0, "max"))
    return ", ".join(f"{name} {percentile(late_ns, share) / 1000:.0f} us" for share, name in shares)


def _swaps(pds: int) -> list[Change]:
    lines = LoopbackLines()
    uri = InterfaceUri("loop", "line")
    specs = [station(pds, more, str(uri)) for more in (0, 1)]
    with (
        TemporaryDirectory(dir=machine.memory_folder()) as folder,
        DropCounters(Path(folder) / "counts", [specs[0].name]) as counters,
    ):
        file = create_image(Path(folder) / "image", plan_layout(specs[0]))
        first = Station(specs[0], file.image, file.wake_waiters)
        first.connect("eap0", lines.open(uri))
        place = EngineStation(first, file, PortChannels(counters, {}))
        engine = Engine([first])
        engine.start(0)
        gc.collect()
        gc.disable()  # as in the engine
        try:
            return [_change(place, engine, specs[number % 2]) for number in range(1, _ROUNDS)]
        finally:
            gc.enable()
            place.file.close()


def _change(place: EngineStation, engine: Engine, spec: Any) -> Change:
    engine.handle_timeout(engine.next_timeout())
    times = [perf_counter_ns()]
    successor = StationReplacement(place, spec, EngineBuses({}, Engine([])))
    times.append(perf_counter_ns())
    before = successor.take_over(engine, engine.next_timeout() - 1)
    times.append(perf_counter_ns())
    for _ in range(2):
        engine.handle_timeout(engine.next_timeout())
        times.append(perf_counter_ns())
    before.release()
    return Change(*(end - begin for begin, end in pairwise(times)))


def _lateness(link: Cable, seconds: float) -> dict[str, Any]:
    with TemporaryDirectory(dir=link.folder) as folder:
        job = {
            "folder": folder,
            "pds": _LATENESS_PDS,
            "priority": PRIORITY,
            "seconds": seconds,
        }
        with link.worker("change_roles.run", job, side=0, cpu=machine.cores()[0]) as engine:
            return engine.answer(seconds)
