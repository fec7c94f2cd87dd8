"""A bus file's slaves in memory, and a session of a master on them whose clock is virtual."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import msgspec

from devicebus.sim.spec import FaultSpec
from eap.ops import bus_session
from eap.ops.bus_session import BusSession
from eap.runtime.busfile import load_or_raise

BUSES = Path(__file__).parents[2] / "config" / "buses"
STEP_NS = 20_000

_load = cache(load_or_raise)


class LoopBus:
    """Slaves that keep their states from session to session."""

    def __init__(self, name: str, folder: Path = BUSES) -> None:
        self.segment = _load(folder / f"{name}.yaml").build()
        self.now_ns = 1_000_000_000

    def clock(self) -> int:
        """Return the time, which goes on by a little with each look."""
        self.now_ns += STEP_NS
        return self.now_ns

    def fault(self, **spec: object) -> None:
        """Let a fault begin."""
        self.segment.begin(msgspec.convert(spec, FaultSpec), self.now_ns)

    @contextmanager
    def lost(self, slave: str) -> Iterator[None]:
        """Switch a slave off for the length of a block."""
        spec = msgspec.convert({"kind": "power", "slave": slave}, FaultSpec)
        self.segment.begin(spec, self.now_ns)
        try:
            yield
        finally:
            self.segment.end(spec, self.now_ns)

    @contextmanager
    def session(self, interface: object = None) -> Iterator[BusSession]:
        """Be a master for the length of a block."""
        port = LoopPort(self)
        try:
            yield BusSession(port, self.clock)
        finally:
            port.close()

    def replace(self, monkeypatch) -> None:
        """Let commands find these slaves, wherever they look for a bus."""
        monkeypatch.setattr(bus_session, "open_bus", self.session)


class LoopPort:
    """Bus port without a network; it always looks readable, so that no reader waits."""

    def __init__(self, bus: LoopBus) -> None:
        self._bus = bus
        self._back: deque[bytes] = deque()
        self._fd, other = os.pipe()
        os.close(other)  # the end of a pipe without a writer is readable

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        os.close(self._fd)

    def send(self, frame: bytes) -> None:
        self._bus.segment.receive_frame(bytearray(frame), self._bus.now_ns, origin=b"")

    def receive(self) -> bytes | None:
        segment, now_ns = self._bus.segment, self._bus.now_ns
        segment.handle_timeout(now_ns)
        self._back += (bytes(each.frame) for each in segment.frames_to_send(now_ns))
        return self._back.popleft() if self._back else None
