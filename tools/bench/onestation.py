"""One station that sends and receives one PD each millisecond, beside a loop in C that does so."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from statistics import median
from typing import Any

import msgspec

from eap.codec.ethercat import ETHERTYPE
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import MacAddr, NetId
from tools.bench import machine, rawloop
from tools.bench.appliance import running, status
from tools.bench.figures import Bar, BarKind, Figure, SkippedError, at_most, median_ratio, report
from tools.bench.machine import ProcessSample
from tools.bench.network import Cable, Page, cable
from tools.bench.pacing import wait
from tools.bench.settings import Settings
from tools.bench.stations import CYCLE_US, DESTINATION, PUBLISHER, SUBSCRIBER

TITLE = "One station at 1 ms, one PD of 600 bytes each way over EtherType: engine beside a C loop"
SIZE = 600
_SETTLE_S = 1.0
_LONGER_S = 60.0
"""A partner runs until its stop word is set, at most so much longer than it is observed."""


def run(settings: Settings) -> list[Figure]:
    """Measure both in turn; raise SkippedError without root, a second core or a C compiler."""
    machine.require_cores()
    if not rawloop.is_possible():
        raise SkippedError(rawloop.NEEDS)
    pairs = []
    with cable() as link, machine.pm_qos(on=True):
        for number in range(settings.rounds):
            settings.tell(f"one station at 1 ms, round {number + 1} of {settings.rounds}")
            found = {}
            for measure in (_ours, _in_c)[:: -1 if number % 2 else 1]:
                with ExitStack() as stack:
                    partner(link, stack, settings.latency_s)
                    found[measure] = measure(link, settings.latency_s)
            pairs.append((found[_ours], found[_in_c]))
    return figures_of(pairs)


def figures_of(pairs: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> list[Figure]:
    """Compare the shares of a core, ours and those of the C loop of the same rounds."""
    ours, theirs = (median(each["cpu"] for each in side) * 100 for side in zip(*pairs, strict=True))
    ratio = median_ratio((left["cpu"], right["cpu"]) for left, right in pairs)
    counts = [left for left, _ in pairs]
    lost, received = (sum(each[key] for each in counts) for key in ("lost", "received"))
    share = at_most(
        "one station, one PD each way at 1 ms: share of a core, of a C loop",
        ratio,
        1.5,
        "",
        f"{ours:.1f} to {theirs:.1f} %",
        limit=f"C loop with the same bytes: {theirs:.1f} %",
    )
    bars = [Bar("engine", ours, BarKind.OURS), Bar("the C loop", theirs, BarKind.LIMIT)]
    return [
        share.compared("one station, one PD each way at 1 ms", "%", bars, 1.5 * theirs),
        report("PDs lost by the station", f"{lost} of {received}", lost),
    ]


def partner(link: Cable, stack: ExitStack, seconds: float) -> None:
    """Run the C loop at the far end until *stack* ends, as the other station."""
    path = link.folder / "page"
    path.unlink(missing_ok=True)
    Page(path)
    job = {
        "page": str(path),
        "interface": link.interface(1),
        "seconds": seconds + _LONGER_S,
        "frame": frame(SUBSCRIBER),
    }
    cpu = machine.cores()[1]
    stack.enter_context(rawloop.raw_loop(link, "station", job, side=1, cpu=cpu)).answer()


def plant(interface: str) -> bytes:
    """Return the plant of the station at the near end."""
    block = f"BLOCK({SIZE})"
    far = {"publisher": SUBSCRIBER, "id": 1, "cycle_us": CYCLE_US, "step": 1}
    station = {
        "name": "near",
        "net_id": "10.134.164.1.1.1",
        "ports": [
            {
                "name": "eap0",
                "kind": "eap",
                "interface": f"ethernet://{interface}",
                "net_id": PUBLISHER,
            }
        ],
        "variables": {"out": block},
        "frames": [{"name": "out", "port": "eap0", "to": "multicast"}],
        "publish": [{"name": "out", "frame": "out", "id": 1, "variables": ["out"]}],
        "subscribe": [
            {"name": "in", "port": "eap0", "from": far, "foreign": True, "variables": {"in": block}}
        ],
    }
    content = {"plant": "one-station", "defaults": {"cycle_us": CYCLE_US}, "stations": [station]}
    return msgspec.json.format(msgspec.json.encode(content))


def frame(publisher: str) -> bytes:
    """Return the Ethernet frame of *publisher*, with one PD."""
    header = MacAddr.parse(DESTINATION) + bytes(6) + ETHERTYPE.to_bytes(2)
    pds = [(PdHeader(1, 0, SIZE), bytes(SIZE))]
    return header + encode_frame(PdFrameHeader(NetId.parse(publisher), 1, 0), pds)


def _in_c(link: Cable, seconds: float) -> dict[str, Any]:
    job = {
        "page": str(link.folder / "page"),
        "interface": link.interface(0),
        "seconds": seconds,
        "frame": frame(PUBLISHER),
    }
    cpu = machine.cores()[0]
    with rawloop.raw_loop(link, "station", job, side=0, cpu=cpu) as worker:
        worker.answer()
        return worker.answer(seconds)


def _ours(link: Cable, seconds: float) -> dict[str, Any]:
    path = link.folder / "one.yaml"
    path.write_bytes(plant(link.interface(0)))
    with running(path, link) as environment:
        wait(_SETTLE_S)
        first = status(link, environment)
        pid = int(first["processes"]["engine"]["pid"])
        os.sched_setaffinity(pid, {machine.cores()[0]})
        wait(_SETTLE_S)  # reading the status has disturbed it
        before = ProcessSample(pid)
        wait(seconds)
        after = ProcessSample(pid)
        last = status(link, environment)
    (old,), (new,) = (each["stations"][0]["pd"]["rx"] for each in (first, last))
    counts = {key: new[key] - old[key] for key in ("received", "lost")}
    if not counts["received"]:
        raise RuntimeError(f"the station receives nothing: {new}")
    return {"cpu": (after.cpu_ns - before.cpu_ns) / seconds / 1e9, **counts}
