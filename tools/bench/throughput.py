"""Frames per second through the whole path, beside a raw socket loop and ZeroMQ.

One round runs all of them one after the other; a figure is the median of the rounds' ratios.  From
round to round publisher and subscriber change cores.
"""

from __future__ import annotations

import importlib.util
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import NamedTuple

import msgspec

from tools.bench import machine
from tools.bench.figures import Figure, at_least, median_ratio, report, skipped
from tools.bench.network import Cable, Page, cable
from tools.bench.settings import Settings
from tools.bench.stations import Shape

TITLE = "Throughput: frames received per second, publisher and subscriber on a core each"


class Case(NamedTuple):
    """Frames to send, and the required rate."""

    name: str
    shape: Shape
    of_raw: float
    of_zmq: float | None = None


CASES = (
    Case("600-byte PD, 1 frame a cycle", Shape(1, 1, 600), 0.7, 1.0),
    Case("600-byte PDs, 32 frames a cycle", Shape(32, 1, 600), 0.7, 1.0),
    Case("10 PDs of 60 bytes a frame", Shape(1, 10, 60), 0.45),
    Case("10 PDs of 140 bytes a frame", Shape(1, 10, 140), 0.45),
)


class Endpoint(NamedTuple):
    """A pair of roles that carries frames from one end to the other.

    *spin* keeps a raw receiver from sleeping; *window* is False for a sender that never waits for
    its receiver, so that frames may be lost.
    """

    send: str
    receive: str
    spin: bool = False
    window: bool = True


OURS = Endpoint("product_roles.publish", "product_roles.subscribe")
RAW = Endpoint("raw_roles.send", "raw_roles.receive")
SPINNING = Endpoint("raw_roles.send", "raw_roles.receive", spin=True)
ZMQ = Endpoint("zmq_roles.publish", "zmq_roles.subscribe", window=False)
ZMQ_WINDOW = Endpoint("zmq_roles.publish", "zmq_roles.subscribe")


def run(settings: Settings) -> list[Figure]:
    """Measure all cases; raise SkippedError without root or a second core."""
    machine.require_cores()
    ways = [OURS, RAW, SPINNING]
    if importlib.util.find_spec("zmq"):
        ways += [ZMQ, ZMQ_WINDOW]
    figures = []
    with cable() as link:
        for case in CASES:
            settings.tell(f"throughput: {case.name}")
            rates: dict[Endpoint, list[float]] = {way: [] for way in ways}
            for number in range(settings.rounds):
                for way in ways:
                    swap = bool(number % 2)
                    rates[way].append(_rate(link, way, case.shape, settings, swap=swap))
            figures += _figures(case, rates)
    return figures


def _figures(case: Case, rates: dict[Endpoint, list[float]]) -> list[Figure]:
    def compared(way: Endpoint, what: str, target: float | None = None) -> Figure:
        name = f"{case.name}: of {what}"
        if way not in rates:
            return skipped(name, "needs pyzmq")
        pairs = list(zip(rates[OURS], rates[way], strict=True))
        ours, theirs = (median(rate / 1000 for rate in side) for side in zip(*pairs, strict=True))
        detail = f"{ours:.0f} of {theirs:.0f} thousand/s"
        if target is None:
            return report(name, f"{median_ratio(pairs):.2f} ({detail})", median_ratio(pairs))
        return at_least(name, median_ratio(pairs), target, detail)

    return [
        compared(RAW, "the raw loop", case.of_raw),
        compared(SPINNING, "a raw loop that never sleeps"),
        compared(ZMQ, "ZeroMQ PUB/SUB", case.of_zmq),
        compared(ZMQ_WINDOW, "ZeroMQ held to a window"),
    ]


def _rate(link: Cable, way: Endpoint, shape: Shape, settings: Settings, *, swap: bool) -> float:
    """Return the frames received per second of one run.

    Raises:
        RuntimeError: not every frame arrived, so the rate means nothing.
    """
    sending, receiving = machine.cores() if not swap else machine.cores()[::-1]
    with ExitStack() as stack:
        page_path = Path(link.folder) / "page"
        page_path.unlink(missing_ok=True)
        page = Page(page_path)
        job = {
            "spin": way.spin,
            "window": way.window,
            "shape": msgspec.structs.asdict(shape),
            "folder": str(link.folder),
            "page": str(page_path),
            "seconds": settings.throughput_s,
            "address": link.address(0),
        }
        for image in Path(link.folder).glob("*.image"):
            image.unlink()
        receiver = stack.enter_context(
            link.worker(way.receive, job | {"interface": link.interface(1)}, side=1, cpu=receiving)
        )
        receiver.answer()
        sender = stack.enter_context(
            link.worker(way.send, job | {"interface": link.interface(0)}, side=0, cpu=sending)
        )
        sent = sender.answer()
        page.words[Page.STOP] = 1
        received = receiver.answer()
    if way.window and (received["received"] != sent["sent"] or received["lost"]):
        raise RuntimeError(f"{way.send}: {sent} but {received}")
    return float(received["received"] / sent["seconds"])
