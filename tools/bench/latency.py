"""One-way latency at 1 kHz: from just before the send to the data in the receiver's hands."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from tools.bench import machine
from tools.bench.figures import Figure, SkippedError, at_most, median_ratio, report, skipped
from tools.bench.network import Cable, Page, cable
from tools.bench.settings import Settings
from tools.bench.stations import Shape

TITLE = "One-way latency of a 600-byte PD at 1 kHz, woken on arrival, beside a blocking raw loop"
SHAPE = Shape(1, 1, 600)
OURS = ("product_roles.publish_paced", "product_roles.subscribe_on_arrival")
RAW = ("raw_roles.send_paced", "raw_roles.receive_stamps")


def run(settings: Settings) -> list[Figure]:
    """Measure with and without PM QoS; raise SkippedError without root or a second core."""
    machine.require_cores()
    figures = []
    with cable() as link:
        for on in (True, False):
            name = f"latency, PM QoS {'on' if on else 'off'}"
            settings.tell(name)
            try:
                with machine.pm_qos(on=on):
                    figures += _measure(link, settings, name)
            except SkippedError as reason:
                figures.append(skipped(name, reason))
    return figures


def _measure(link: Cable, settings: Settings, name: str) -> list[Figure]:
    ours: list[dict[str, Any]] = []
    raw: list[dict[str, Any]] = []
    rounds = max(2, settings.rounds // 2)
    for number in range(rounds):
        for way, results in ((OURS, ours), (RAW, raw)):
            results.append(_run(link, way, settings.latency_s, swap=bool(number % 2)))
    pairs = [(a["p50"], b["p50"]) for a, b in zip(ours, raw, strict=True)]
    detail = f"{_us(ours, 'p50')} to {_us(raw, 'p50')} µs"
    figures = [at_most(f"{name}: p50, ratio to the raw loop", median_ratio(pairs), 1.3, "", detail)]
    tails = ", ".join(f"{key} {_us(ours, key)} to {_us(raw, key)} µs" for key in ("p99", "max"))
    return [*figures, report(f"{name}: tails", tails)]


def _us(results: list[dict[str, Any]], key: str) -> str:
    return f"{median(result[key] for result in results) / 1000:.1f}"


def _run(link: Cable, way: tuple[str, str], seconds: float, *, swap: bool) -> dict[str, Any]:
    sending, receiving = machine.cores() if not swap else machine.cores()[::-1]
    folder = Path(link.folder)
    for left in (folder / "page", *folder.glob("*.image")):
        left.unlink(missing_ok=True)
    page = Page(folder / "page")
    job = {
        "shape": msgspec.structs.asdict(SHAPE),
        "folder": str(folder),
        "page": str(folder / "page"),
        "seconds": seconds,
    }
    with ExitStack() as stack:
        receiver = stack.enter_context(
            link.worker(way[1], job | {"interface": link.interface(1)}, side=1, cpu=receiving)
        )
        receiver.answer()
        sender = stack.enter_context(
            link.worker(way[0], job | {"interface": link.interface(0)}, side=0, cpu=sending)
        )
        sender.answer()
        page.words[Page.STOP] = 1
        return receiver.answer()
