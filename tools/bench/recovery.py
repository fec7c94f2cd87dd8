"""Faults on the bus of a running plant: how long after their end all slaves are in OP again.

docs/faults.md says the same of the master alone, on a virtual clock.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import monotonic_ns
from typing import Any, NamedTuple

import eap
from eap.net.ticker import Ticker
from eap.ops.client import ControlClient, connect_station
from eap.runtime.attach import AttachedStation
from eap.runtime.folder import VARIABLE
from tools.bench import buses, machine
from tools.bench.appliance import running
from tools.bench.buses import PORT, STATION
from tools.bench.cycle import CYCLE_US, OCTETS, SLAVES
from tools.bench.figures import Figure, report
from tools.bench.machine import memory_folder
from tools.bench.settings import Settings

TITLE = f"Faults in a running plant, {SLAVES} simulated slaves at 1 ms: until all are in OP again"
FAULT_MS = 300
_OP = 8
_LOOK_NS = 200_000
_WITHIN_NS = 20_000_000_000
_MS = 1_000_000


class Case(NamedTuple):
    """A fault, and what it is."""

    name: str
    fault: dict[str, Any]


CASES = (
    Case("the last slave has no power", {"kind": "power", "slave": f"slave-{SLAVES}"}),
    Case("the first slave has no power", {"kind": "power", "slave": "slave-1"}),
    Case("the cable in the middle is cut", {"kind": "cut", "slave": f"slave-{SLAVES // 2}"}),
    Case("no frame comes back", {"kind": "loss"}),
)


class Times(NamedTuple):
    """In nanoseconds: from the command until the plant knew, and from the end until OP."""

    known_ns: int
    again_ns: int


def run(settings: Settings) -> list[Figure]:
    """Let each fault happen some times; raise RuntimeError if the slaves do not come back."""
    machine.require_cores()
    rounds = max(2, settings.rounds)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(dir=memory_folder())))
        (folder / "bus.yaml").write_bytes(buses.encode(buses.bus(SLAVES, OCTETS)))
        (folder / "plant.yaml").write_bytes(buses.encode(buses.plant("sim://bus.yaml", CYCLE_US)))
        bench = _Bench(folder / "plant.yaml", stack)
        found = []
        for case in CASES:
            settings.tell(f"recovery: {case.name}")
            found.append(figure(case.name, [bench.measure(case.fault) for _ in range(rounds)]))
    return found


def figure(name: str, times: Sequence[Times]) -> Figure:
    """Say how long it took in the middle and at most."""
    known = [each.known_ns / _MS for each in times]
    again = [each.again_ns / _MS for each in times]
    return report(
        f"{name} for {FAULT_MS} ms",
        f"median {median(again):.0f} ms, longest {max(again):.0f} ms after its end"
        f" (seen within {max(known):.0f} ms)",
        median(again),
    )


class _Bench:
    """A running plant, read like a user program and like a command."""

    def __init__(self, plant: Path, stack: ExitStack) -> None:
        environment = stack.enter_context(running(plant, None))
        with _environment(environment[VARIABLE]):
            self._client: ControlClient = stack.enter_context(connect_station(STATION, None))
            self._station: AttachedStation = stack.enter_context(eap.attach(STATION))
        self._ticker = Ticker()
        stack.callback(self._ticker.close)
        self._wait_for(is_well=True)

    def measure(self, fault: dict[str, Any]) -> Times:
        """Let *fault* happen and wait until all is well again."""
        where = {"station": STATION, "port": PORT}
        self._client.request("bus_fault", **where, command=fault | {"for_ms": FAULT_MS})
        begin_ns = monotonic_ns()
        known_ns = self._wait_for(is_well=False) - begin_ns
        again_ns = self._wait_for(is_well=True) - begin_ns - FAULT_MS * _MS
        return Times(known_ns, again_ns)

    def _wait_for(self, *, is_well: bool) -> int:
        end_ns = monotonic_ns() + _WITHIN_NS
        while (self._station[f"{PORT}.state"] == _OP) is not is_well:
            now_ns = monotonic_ns()
            if now_ns > end_ns:
                raise RuntimeError(f"{PORT}.state is {self._station[f'{PORT}.state']} for 20 s")
            self._ticker.wait(now_ns + _LOOK_NS)
        return monotonic_ns()


@contextmanager
def _environment(runtime: str) -> Iterator[None]:
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = runtime
    try:
        yield
    finally:
        os.environ.pop(VARIABLE)
        if before is not None:
            os.environ[VARIABLE] = before
