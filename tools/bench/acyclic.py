"""Our master beside SOEM on the same simulated segment: scan, read an object, write a file.

The segment is one process, each master another at the other end of a veth pair.  A round runs both
masters one after the other; from round to round they change their order, and master and segment
their cores.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from statistics import median
from typing import Any, NamedTuple

from tools.bench import buses, machine
from tools.bench.figures import Figure, SkippedError, at_most, median_ratio
from tools.bench.network import Cable, cable
from tools.bench.settings import Settings
from tools.bench.simulator import Simulator, simulator

TITLE = "Our master beside SOEM (pysoem): the same 16 simulated slaves, over a veth pair"
SLAVES = 16
OCTETS = 512
OURS = "bus_roles.acyclic"
SOEM = "soem_roles.acyclic"
JOB = {"scans": 5, "reads": 500, "files": 1, "size": buses.FILE_SIZE}


class Case(NamedTuple):
    """A figure: its key in the answers, its unit in nanoseconds, and the ratio allowed."""

    key: str
    name: str
    unit: str
    unit_ns: int
    ratio: float


CASES = (
    Case("read", "SDO read, expedited: time, ratio to SOEM", "µs", 1_000, 1.5),
    Case("file", "FoE write of 1 MB: time, ratio to SOEM", "ms", 1_000_000, 1.5),
    Case("scan", f"scan of {SLAVES} slaves: time, ratio to SOEM", "ms", 1_000_000, 2.0),
)


def run(settings: Settings) -> list[Figure]:
    """Measure all cases; raise SkippedError without root, a second core or pysoem."""
    machine.require_cores()
    if importlib.util.find_spec("pysoem") is None:
        raise SkippedError("needs pysoem")
    ours: list[dict[str, Any]] = []
    soem: list[dict[str, Any]] = []
    with cable() as link:
        path = link.folder / "bus.yaml"
        path.write_bytes(buses.encode(buses.bus(SLAVES, OCTETS)))
        with simulator(link, path) as segment:
            for number in range(settings.rounds):
                settings.tell(f"masters, round {number + 1} of {settings.rounds}")
                order = ((OURS, ours), (SOEM, soem))
                for role, results in order if number % 2 else order[::-1]:
                    results.append(_measure(link, segment, role, swap=number // 2 % 2 == 1))
    return figures(ours, soem)


def figures(ours: Sequence[dict[str, Any]], soem: Sequence[dict[str, Any]]) -> list[Figure]:
    """Compare the medians of each round; the answers of both come in the order of the rounds."""
    found = []
    for case in CASES:
        pairs = [
            (median(left[case.key]), median(right[case.key]))
            for left, right in zip(ours, soem, strict=True)
        ]
        left, right = (median(side) / case.unit_ns for side in zip(*pairs, strict=True))
        detail = f"{left:.3g} to {right:.3g} {case.unit}"
        found.append(at_most(case.name, median_ratio(pairs), case.ratio, "", detail))
    return found


def _measure(link: Cable, segment: Simulator, role: str, *, swap: bool) -> dict[str, Any]:
    near, far = machine.cores() if not swap else machine.cores()[::-1]
    segment.pin(far)
    job = JOB | {"interface": link.interface(0)}
    with link.worker(role, job, side=0, cpu=near) as worker:
        answer = worker.answer()
    if answer["slaves"] != SLAVES:
        raise RuntimeError(f"{role} found {answer['slaves']} slaves, there are {SLAVES}")
    return answer
