"""Frames per second through the whole path, beside raw socket loops and other middleware.

One round runs all of them one after the other; a figure is the median of the rounds' ratios.  From
round to round publisher and subscriber change cores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import NamedTuple

from tools.bench import machine
from tools.bench.endpoints import Endpoint, carry
from tools.bench.figures import Bar, BarKind, Figure, at_least, median_ratio, report, skipped
from tools.bench.network import Cable, cable
from tools.bench.settings import Settings
from tools.bench.stations import Shape

TITLE = "Throughput: frames received per second, publisher and subscriber on a core each"

OURS = Endpoint("ours", "product_roles.publish", "product_roles.subscribe", kind=BarKind.OURS)
RAW = Endpoint("the raw Python loop", "raw_roles.send", "raw_roles.receive", kind=BarKind.LIMIT)
C = Endpoint("the C loop", "c.send", "c.receive", kind=BarKind.LIMIT)
C_SPINNING = Endpoint(
    "a C loop that never sleeps", "c.send", "c.receive", batch=0, kind=BarKind.LIMIT
)
C_BATCH = Endpoint(
    "a C loop with batches of 32", "c.send", "c.receive", batch=32, kind=BarKind.LIMIT
)
ZMQ = Endpoint(
    "ZeroMQ PUB/SUB", "zmq_roles.send", "zmq_roles.receive", ("pyzmq", "zmq"), window=False
)
ZMQ_WINDOW = ZMQ._replace(name="ZeroMQ held to a window", window=True)
ZENOH = Endpoint("zenoh", "zenoh_roles.send", "zenoh_roles.receive", ("eclipse-zenoh", "zenoh"))
DDS = Endpoint("CycloneDDS", "dds_roles.send", "dds_roles.receive", ("cyclonedds", "cyclonedds"))


class Case(NamedTuple):
    """Frames to send, and those beside it with the required rate of each that has one."""

    name: str
    shape: Shape
    beside: dict[Endpoint, float | None]
    limit: Endpoint = C


CASES = (
    Case(
        "600-byte PD, 1 frame a cycle",
        Shape(1, 1, 600),
        {RAW: 1.0, C: None, C_SPINNING: None, ZMQ: None, ZMQ_WINDOW: None, ZENOH: None, DDS: None},
    ),
    Case(
        "600-byte PDs, 32 frames a cycle",
        Shape(32, 1, 600),
        {RAW: 1.6, C: 0.7, C_BATCH: None, ZMQ: None, ZMQ_WINDOW: None},
        C_BATCH,
    ),
    Case(
        "10 PDs of 60 bytes a frame",
        Shape(1, 10, 60),
        {RAW: 1.2, C: None, ZENOH: 1.5, ZMQ_WINDOW: None},
    ),
    Case("10 PDs of 140 bytes a frame", Shape(1, 10, 140), {RAW: None, C: None}),
)


def run(settings: Settings) -> list[Figure]:
    """Measure all cases; raise SkippedError without root or a second core."""
    machine.require_cores()
    figures = []
    with cable() as link:
        for case in CASES:
            settings.tell(f"throughput: {case.name}")
            ways = [OURS, *(way for way in case.beside if not way.lacks())]
            rates: dict[str, list[float]] = {way.name: [] for way in ways}
            for number in range(settings.rounds):
                for way in ways[:: -1 if number % 2 else 1]:
                    seconds, swap = settings.throughput_s, number // 2 % 2 == 1
                    rates[way.name].append(_rate(link, way, case.shape, seconds, swap=swap))
            figures += figures_of(case, rates)
    return figures


def figures_of(case: Case, rates: Mapping[str, Sequence[float]]) -> list[Figure]:
    """Compare our frames a second with those of the others in the same rounds, by their names."""
    figures = []
    middle = {name: median(values) / 1000 for name, values in rates.items()}
    for way, target in case.beside.items():
        name = f"{case.name}: of {way.name}"
        if way.name not in rates:
            figures.append(skipped(name, way.lacks()))
            continue
        ratio = median_ratio(zip(rates[OURS.name], rates[way.name], strict=True))
        detail = f"{middle[OURS.name]:.0f} of {middle[way.name]:.0f} thousand/s"
        if target is None:
            figures.append(report(name, f"{ratio:.2f} ({detail})", ratio))
            continue
        limit = case.limit.name
        limit += f": {middle[limit]:.0f} thousand/s" if limit in middle else ", not measured"
        figures.append(at_least(name, ratio, target, detail, limit=limit))
    bars = [Bar(each.name, middle[each.name], each.kind) for each in (OURS, *case.beside)
            if each.name in middle]  # fmt: skip
    goal = max(
        (target * middle[way.name] for way, target in case.beside.items()
         if target is not None and way.name in middle),
        default=None,
    )  # fmt: skip
    figures[0] = figures[0].compared(case.name, "thousand/s", bars, goal)
    return figures


def _rate(link: Cable, way: Endpoint, shape: Shape, seconds: float, *, swap: bool) -> float:
    """Return the frames received per second of one run."""
    sent, received = carry(link, way, shape, seconds, swap=swap)
    return float(received["received"] / sent["seconds"])
