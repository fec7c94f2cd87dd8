"""The engine process's own loop over a small plant, its lateness noted cycle by cycle."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from time import monotonic_ns
from typing import Any

import msgspec

from eap.engine.build import EnginePlant
from eap.engine.process import StopFlag, run_cycles
from eap.ids import InterfaceUri, NetId
from eap.net import realtime
from eap.pd.engine import Engine
from eap.pd.spec import (
    CounterSource,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.runtime.handover import NO_DESCRIPTOR, Handover, SharedSocket
from eap.supervisor.sockets import SharedSockets
from tools.bench.pacing import answer
from tools.bench.timing import Latencies

_PM_QOS = Path("/dev/cpu_dma_latency")
_SIZE = 100


class Recorder(Engine):
    """Passes everything on to the engine, and notes how late each wake-up came."""

    def __init__(self, engine: Engine, end_ns: int, stop: StopFlag) -> None:
        super().__init__([])
        self.latencies = Latencies()
        self._engine = engine
        self._end_ns = end_ns
        self._stop = stop

    def next_timeout(self) -> int:
        """Return when the engine is due."""
        return self._engine.next_timeout()

    def handle_timeout(self, now_ns: int) -> None:
        """Run what is due."""
        self.latencies.enter(now_ns - self._engine.next_timeout())
        self._engine.handle_timeout(now_ns)
        if now_ns > self._end_ns:
            self._stop.is_set = True


def run(job: dict[str, Any]) -> None:
    """Run two stations that send to each other, in the loop of the engine process."""
    folder, cycle_us = Path(job["folder"]), job["cycle_us"]
    stations = tuple(_station(number, cycle_us) for number in (1, 2))
    with SharedSockets(folder / "control") as shared:
        handover = Handover(
            supervisor=os.getppid(),
            folder=str(folder),
            plant="lateness",
            plant_file="",
            stations=stations,
            sockets=own_sockets(shared.fit(stations)),
        )
        with closing(EnginePlant(handover)) as plant:
            realtime.prepare(job["priority"], [job["cpu"]])
            if not job["pm_qos"]:
                _release_pm_qos()
            stop, now_ns = StopFlag(), monotonic_ns()
            plant.start(now_ns)
            recorder = Recorder(plant.engine, now_ns + int(job["seconds"] * 1e9), stop)
            plant.engine = recorder
            answer({"ready": True})
            with socket.socket(fileno=os.dup(shared.engine_link)) as link:
                run_cycles(plant, link, stop, lambda: None)
            answer({"late_ns": recorder.latencies.values()})


def _station(number: int, cycle_us: int) -> StationSpec:
    other = 3 - number
    return StationSpec(
        name=f"station-{number}",
        net_id=NetId.parse(f"127.0.1.{number}.1.1"),
        cycle_us=cycle_us,
        phase_us=(number - 1) * cycle_us // 2,  # a wake-up for each
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse(f"udp://127.0.1.{number}"),
                NetId.parse(f"127.0.1.{number}.2.1"),
            ),
        ),
        variables=(
            VariableSpec("count", "UDINT", Writer.ENGINE),
            VariableSpec("block", f"BLOCK({_SIZE})"),
            VariableSpec("far-count", "UDINT", Writer.ENGINE),
            VariableSpec("far-block", f"BLOCK({_SIZE})", Writer.ENGINE),
        ),
        sources=(CounterSource("count"),),
        frames=(
            TxFrameSpec(
                "out", "eap0", f"127.0.1.{other}", (TxPdSpec("state", 1, ("count", "block")),)
            ),
        ),
        subscriptions=(
            RxPdSpec(
                "in",
                "eap0",
                1,
                ("far-count", "far-block"),
                f"127.0.1.{other}.2.1",
                timeout_ms=100,
                sender_cycle_us=cycle_us,
                step=1,
            ),
        ),
    )


def own_sockets(shared: Iterable[SharedSocket]) -> tuple[SharedSocket, ...]:
    """Return descriptions with descriptors that the engine may close."""
    return tuple(map(_own, shared))


def _own(shared: SharedSocket) -> SharedSocket:
    """Give the engine a descriptor of its own, as it has in a process of its own."""
    if shared.engine_fd == NO_DESCRIPTOR:
        return shared
    return msgspec.structs.replace(shared, engine_fd=os.dup(shared.engine_fd))


def _release_pm_qos() -> None:
    """Close what ``prepare`` opened to keep the processors awake."""
    for entry in Path("/proc/self/fd").iterdir():
        if entry.is_symlink() and entry.readlink() == _PM_QOS:
            os.close(int(entry.name))
