"""Cycles of process data as fast as frames come back: our station, SOEM, and a loop in C.

Each master brings the simulated slaves to OP and exchanges with them.  Then the raw loop in C takes
the place of the segment, so that the master limits the rate, and each exchanges with that.
"""

from __future__ import annotations

import importlib.util
import os
import signal
from collections.abc import Sequence
from contextlib import ExitStack
from statistics import median
from typing import Any

from devicebus.wire.datagram import Command, Datagram, DatagramHeader, encode_frame
from eap.codec.ethercat import ETHERTYPE
from eap.net.busport import BUS_MULTICAST_MAC
from tools.bench import buses, machine, rawloop
from tools.bench.figures import Bar, BarKind, Figure, SkippedError, at_least, median_ratio, report
from tools.bench.network import Cable, Page, cable
from tools.bench.rawloop import SLAVES
from tools.bench.settings import Settings
from tools.bench.simulator import simulator

TITLE = "Bus cycles flat out: 16 slaves, 512 bytes, our station beside the loop of pysoem (SOEM)"
OCTETS = 512
CYCLE_US = 1000
OURS, SOEM, C = "bus_roles.cycles", "soem_roles.cycles", "c.exchange"


def run(settings: Settings) -> list[Figure]:
    """Measure all; raise SkippedError without root, a second core, a C compiler or pysoem."""
    machine.require_cores()
    if importlib.util.find_spec("pysoem") is None:
        raise SkippedError("needs pysoem")
    if not rawloop.is_possible():
        raise SkippedError(rawloop.NEEDS)
    found: dict[str, list[list[float]]] = {role: [] for role in (OURS, SOEM, C)}
    with cable() as link:
        bus, plant = link.folder / "bus.yaml", link.folder / "plant.yaml"
        bus.write_bytes(buses.encode(buses.plain_bus(SLAVES, OCTETS)))
        interface = f"ethernet://{link.interface(0)}"
        plant.write_bytes(buses.encode(buses.plant(interface, CYCLE_US, bus=bus.name)))
        for number in range(settings.rounds):
            settings.tell(f"bus cycles, round {number + 1} of {settings.rounds}")
            for role in (OURS, SOEM)[:: -1 if number % 2 else 1]:
                found[role].append(_patiently(link, role, settings.throughput_s))
            found[C].append([_loop(link, settings.throughput_s)])
    return figures_of(found[OURS], found[SOEM], found[C])


def figures_of(
    ours: Sequence[Sequence[float]], soem: Sequence[Sequence[float]], c: Sequence[Sequence[float]]
) -> list[Figure]:
    """Compare the cycles a second of all rounds: those with simulated slaves, then those in C."""
    limit = median(rates[0] for rates in c) / 1000
    figures = []
    for number, slaves in ((1, "answered by C"), (0, "simulated")):
        pairs = [(left[number], right[number]) for left, right in zip(ours, soem, strict=True)]
        left, right = (median(side) / 1000 for side in zip(*pairs, strict=True))
        name = f"bus cycles, 16 slaves {slaves}: of pysoem's own loop"
        detail = f"{left:.1f} of {right:.1f} thousand/s"
        said = f"the C loop: {limit:.1f} thousand/s" if number else ""
        bars = [Bar("ours", left, BarKind.OURS), Bar("SOEM (pysoem)", right, BarKind.PEER)]
        if number:
            bars.append(Bar("the C loop", limit, BarKind.LIMIT))
        figure = at_least(name, median_ratio(pairs), 1.0, detail, limit=said)
        title = f"16 slaves {slaves}"
        figures.append(figure.compared(title, "thousand/s", bars, right))
    ratio = median_ratio((left[1], right[0]) for left, right in zip(ours, c, strict=True))
    detail = f"{median(rates[1] for rates in ours) / 1000:.1f} of {limit:.1f} thousand/s"
    name = "bus cycles, 16 slaves answered by C: of the C loop"
    return [*figures, report(name, f"{ratio:.2f} ({detail})", ratio)]


def frame() -> bytes:
    """Return the Ethernet frame of one cycle."""
    header = DatagramHeader(Command.LRW, 0, 0, 0, OCTETS)
    ethercat = encode_frame([Datagram(header, bytes(OCTETS), 0)])
    return BUS_MULTICAST_MAC + bytes(6) + ETHERTYPE.to_bytes(2) + ethercat


def _patiently(link: Cable, role: str, seconds: float) -> list[float]:
    """Measure, and once more if a master does not bring the slaves up: the machine may be busy."""
    try:
        return _masters(link, role, seconds)
    except RuntimeError:
        return _masters(link, role, seconds)


def _masters(link: Cable, role: str, seconds: float) -> list[float]:
    """Return cycles a second with the simulated segment, and with the loop in its place."""
    near, far = machine.cores()
    page = _page(link)
    job: dict[str, Any] = {
        "page": str(link.folder / "page"),
        "folder": str(link.folder),
        "plant": str(link.folder / "plant.yaml"),
        "interface": link.interface(0),
        "seconds": seconds,
        "phases": 2,
    }
    (link.folder / "bus.image").unlink(missing_ok=True)
    with ExitStack() as stack:
        segment = stack.enter_context(simulator(link, link.folder / "bus.yaml"))
        segment.pin(far)
        master = stack.enter_context(link.worker(role, job, side=0, cpu=near))
        master.answer()
        page.words[Page.PHASE] = 1
        master.answer(seconds)
        os.kill(segment.pid, signal.SIGSTOP)
        stack.callback(os.kill, segment.pid, signal.SIGCONT)
        _segment(link, stack)
        page.words[Page.PHASE] = 2
        answer = master.answer(seconds)
    if answer["slaves"] != SLAVES:
        raise RuntimeError(f"{role} found {answer['slaves']} slaves, there are {SLAVES}")
    return [float(rate) for rate in answer["rates"]]


def _loop(link: Cable, seconds: float) -> float:
    _page(link)
    job = {"page": str(link.folder / "page"), "interface": link.interface(0), "seconds": seconds}
    near, _ = machine.cores()
    with ExitStack() as stack:
        _segment(link, stack)
        more = job | {"frame": frame()}
        worker = stack.enter_context(rawloop.raw_loop(link, "exchange", more, side=0, cpu=near))
        worker.answer()
        answer = worker.answer(seconds)
    return float(answer["cycles"] / answer["seconds"])


def _segment(link: Cable, stack: ExitStack) -> None:
    """Have the loop in C answer as the segment until *stack* ends."""
    job = {
        "page": str(link.folder / "page"),
        "interface": link.interface(1),
        "frame": frame(),
    }
    cpu = machine.cores()[1]
    stack.enter_context(rawloop.raw_loop(link, "segment", job, side=1, cpu=cpu)).answer()


def _page(link: Cable) -> Page:
    path = link.folder / "page"
    path.unlink(missing_ok=True)
    return Page(path)
