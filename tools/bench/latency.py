"""One-way latency at 1 kHz: from just before the send to the data in the receiver's hands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from tools.bench import machine
from tools.bench.endpoints import Endpoint, carry
from tools.bench.figures import (
    Bar,
    BarKind,
    Figure,
    SkippedError,
    at_most,
    median_ratio,
    report,
    skipped,
)
from tools.bench.network import Cable, cable
from tools.bench.settings import Settings
from tools.bench.stations import Shape

TITLE = "One-way latency of a 600-byte PD at 1 kHz, woken on arrival, beside blocking loops"
SHAPE = Shape(1, 1, 600)
OURS = Endpoint(
    "ours", "product_roles.publish_paced", "product_roles.subscribe_on_arrival", kind=BarKind.OURS
)
SPINNING = OURS._replace(name="ours with spin: true", batch=0)
RAW = Endpoint(
    "the raw Python loop", "raw_roles.send_paced", "raw_roles.receive_stamps", kind=BarKind.LIMIT
)
C = Endpoint("the C loop", "c.send_paced", "c.receive_stamps", kind=BarKind.LIMIT)
PEERS = tuple(
    Endpoint(name, f"{module}.send_paced", f"{module}.receive_stamps", package)
    for name, module, package in (
        ("ZeroMQ PUB/SUB", "zmq_roles", ("pyzmq", "zmq")),
        ("zenoh", "zenoh_roles", ("eclipse-zenoh", "zenoh")),
        ("CycloneDDS", "dds_roles", ("cyclonedds", "cyclonedds")),
    )
)
TARGETS = {True: 1.3, False: 1.15}
"""Largest ratio to the raw Python loop, with and without PM QoS."""


def run(settings: Settings) -> list[Figure]:
    """Measure with and without PM QoS; raise SkippedError without root or a second core."""
    machine.require_cores()
    figures = []
    with cable() as link:
        for on, target in TARGETS.items():
            name = f"latency, PM QoS {'on' if on else 'off'}"
            settings.tell(name)
            try:
                with machine.pm_qos(on=on):
                    figures += figures_of(name, target, _measure(link, settings))
            except SkippedError as reason:
                figures.append(skipped(name, reason))
    return figures


def figures_of(
    name: str, target: float, results: Mapping[str, Sequence[dict[str, Any]]]
) -> list[Figure]:
    """Compare ours with the others; *results* has distributions in nanoseconds, by round."""
    ours, limit = results[OURS.name], "the C loop, not measured"
    if C.name in results:
        limit = f"{C.name}: {_us(results[C.name], 'p50')} µs"
    figures = []
    for way in (RAW, C, *PEERS):
        title = f"{name}: p50, ratio to {way.name}"
        if way.name not in results:
            figures.append(skipped(title, way.lacks()))
            continue
        theirs = results[way.name]
        ratio = median_ratio((a["p50"], b["p50"]) for a, b in zip(ours, theirs, strict=True))
        detail = f"{_us(ours, 'p50')} to {_us(theirs, 'p50')} µs"
        if way is RAW:
            figures.append(at_most(title, ratio, target, "", detail, limit=limit))
        else:
            figures.append(report(title, f"{ratio:.2f} ({detail})", ratio))
    middle = {each: median(found["p50"] for found in results[each]) / 1000 for each in results}
    bars = [Bar(way.name, middle[way.name], way.kind) for way in (OURS, SPINNING, RAW, C, *PEERS)
            if way.name in middle]  # fmt: skip
    figures[0] = figures[0].compared(
        name.removeprefix("latency, "), "µs", bars, target * middle[RAW.name]
    )
    raw = results[RAW.name]
    if SPINNING.name in results:
        spinning = results[SPINNING.name]
        ratio = median_ratio((a["p50"], b["p50"]) for a, b in zip(spinning, raw, strict=True))
        detail = f"{_us(spinning, 'p50')} to {_us(raw, 'p50')} µs"
        title = f"{name}: p50 {SPINNING.name}, ratio to {RAW.name}"
        figures.append(report(title, f"{ratio:.2f} ({detail})", ratio))
    tails = ", ".join(f"{key} {_us(ours, key)} to {_us(raw, key)} µs" for key in ("p99", "max"))
    return [*figures, report(f"{name}: tails, ours to {RAW.name}", tails)]


def _measure(link: Cable, settings: Settings) -> dict[str, list[dict[str, Any]]]:
    ways = [way for way in (OURS, SPINNING, RAW, C, *PEERS) if not way.lacks()]
    results: dict[str, list[dict[str, Any]]] = {way.name: [] for way in ways}
    for number in range(max(2, settings.rounds // 2 + 1)):
        for way in ways[:: -1 if number % 2 else 1]:
            seconds = settings.latency_s
            _, found = carry(link, way, SHAPE, seconds, swap=number // 2 % 2 == 1)
            results[way.name].append(found)
    return results


def _us(results: Sequence[dict[str, Any]], key: str) -> str:
    return f"{median(result[key] for result in results) / 1000:.1f}"
