"""The engine process's own loop while its station is given other specifications."""

from __future__ import annotations

import os
import socket
from contextlib import closing
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.engine.build import EnginePlant
from eap.engine.process import StopFlag, run_cycles
from eap.errors import EapError
from eap.ids import InterfaceUri, NetId
from eap.net import realtime
from eap.pd.report import station_status
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
    record_to_lines,
)
from eap.runtime.engine_messages import Configure
from eap.runtime.handover import Handover
from eap.supervisor.sockets import SharedSockets
from tools.bench.engine_roles import Recorder, own_sockets
from tools.bench.pacing import answer

CYCLE_US = 1000
PDS_OF_A_FRAME = 10
_ADDRESS = "127.0.1.1"
_NET_ID = "127.0.1.1.2.1"
_QUIET_NS = 100_000_000
"""Between two changes."""


def station(pds: int, more: int = 0, interface: str = f"udp://{_ADDRESS}") -> StationSpec:
    """Return a station that sends *pds* PDs of three values to itself, and *more* unreceived."""
    names = [f"pd{number}" for number in range(pds)]
    frames = [
        TxFrameSpec(
            f"frame{first}",
            "eap0",
            _ADDRESS,
            tuple(
                TxPdSpec(name, 1 + first + at, _variables(name))
                for at, name in enumerate(names[first : first + PDS_OF_A_FRAME])
            ),
        )
        for first in range(0, pds, PDS_OF_A_FRAME)
    ]
    others = [f"more{number}" for number in range(more)]
    frames = [
        TxFrameSpec(name, "eap0", _ADDRESS, (TxPdSpec(name, 60_000 + at, _variables(name)),))
        for at, name in enumerate(others)
    ] + frames
    return StationSpec(
        name="station",
        net_id=NetId.parse("127.0.1.1.1.1"),
        cycle_us=CYCLE_US,
        ports=(
            PortSpec("eap0", PortKind.EAP, InterfaceUri.parse(interface), NetId.parse(_NET_ID)),
        ),
        variables=tuple(
            VariableSpec(variable, "REAL", writer)
            for writer, prefix in ((Writer.APPLICATION, ""), (Writer.ENGINE, "far-"))
            for name in (others if not prefix else []) + names
            for variable in _variables(prefix + name)
        ),
        frames=tuple(frames),
        subscriptions=tuple(
            RxPdSpec(
                f"far-{name}",
                "eap0",
                1 + at,
                _variables(f"far-{name}"),
                _NET_ID,
                timeout_ms=100,
                sender_cycle_us=CYCLE_US,
                step=1,
            )
            for at, name in enumerate(names)
        ),
    )


def _variables(pd: str) -> tuple[str, ...]:
    return tuple(f"{pd}.{axis}" for axis in "xyz")


class Changer(Recorder):
    """Requests one specification after the other, and records the cycles in between."""

    def __init__(
        self, plant: EnginePlant, end_ns: int, stop: StopFlag, folder: Path, pds: int
    ) -> None:
        super().__init__(plant.engine, end_ns, stop)
        self.changes = 0
        self.quiet: list[int] = []
        self.disturbed: list[int] = []
        self.cycle_ns: list[int] = []
        self.refused = ""
        self._plant = plant
        self._paths = [folder / "0.spec", folder / "1.spec"]
        for more, path in enumerate(self._paths):
            path.write_bytes(record_to_lines(station(pds, more)))
        self._begin_ns = monotonic_ns() + 5 * _QUIET_NS

    def handle_timeout(self, now_ns: int) -> None:
        """Run what is due, and begin the next change when it is time."""
        is_changing = self._plant.rebuilder.is_building
        late_ns = now_ns - self.next_timeout()
        super().handle_timeout(now_ns)
        (self.disturbed if is_changing else self.quiet).append(late_ns)
        if is_changing:
            self._begin_ns = now_ns + _QUIET_NS
        elif now_ns > self._begin_ns:
            self._begin_ns = now_ns + _QUIET_NS
            self.changes += 1
            path = str(self._paths[self.changes % 2])
            request = Configure(id=self.changes, station="station", path=path)
            self._plant.rebuilder.serve(request, now_ns, self._note)

    def _note(self, error: EapError | None) -> None:
        self.refused = self.refused or str(error or "")


def run(job: dict[str, Any]) -> None:
    """Run one station that changes again and again, and answer how late its cycles were."""
    folder = Path(job["folder"])
    spec = station(job["pds"])
    with SharedSockets(folder / "control") as shared:
        handover = Handover(
            os.getppid(), str(folder), "change", "", (spec,), own_sockets(shared.fit((spec,)))
        )
        with closing(EnginePlant(handover)) as plant:
            realtime.prepare(job["priority"], [job["cpu"]])
            stop, now_ns = StopFlag(), monotonic_ns()
            plant.start(now_ns)
            end_ns = now_ns + int(job["seconds"] * 1e9)
            engine = plant.engine
            changer = Changer(plant, end_ns, stop, folder, job["pds"])
            plant.engine = changer
            with socket.socket(fileno=os.dup(shared.engine_link)) as link:
                run_cycles(plant, link, stop, lambda: None)
            plant.engine = engine
            received = station_status(plant.image("station"), monotonic_ns())["pd"]["rx"]
            answer(
                {
                    "changes": changer.changes,
                    "refused": changer.refused,
                    "quiet_ns": changer.quiet,
                    "disturbed_ns": changer.disturbed,
                    "lost": sum(pd["lost"] + pd["duplicated"] for pd in received),
                }
            )
