"""Replies to the frame of a cycle for the compiled part: inputs and counters as without it.

Where the compiled part was not built, both sides are Python and nothing can differ.
"""

from __future__ import annotations

from typing import Any

from devicebus.master.bus import MasterSettings
from devicebus.master.cycle import Cycle, CycleStats, Participation
from devicebus.master.image import BusImage, SlaveProcessData, plan_image
from devicebus.master.link import LinkStats
from devicebus.master.master import Master
from devicebus.master.pdo import ProcessDataChannel
from devicebus.wire.datagram import frmw
from devicebus.wire.register import Register

_MS = 1_000_000
_STATIONS = (1001, 1002)


class _Side:
    """A master whose cycle was laid out without a scan."""

    def __init__(self, *, is_quiet: bool) -> None:
        self._is_quiet = is_quiet
        self._master = Master(MasterSettings())
        bus = self._master._bus  # noqa: SLF001  there is no bus to bring up
        slaves = [
            SlaveProcessData(
                station,
                (
                    ProcessDataChannel(2, 0x1000, 0x64, is_output=True, pdos=(), fixed_size=2),
                    ProcessDataChannel(3, 0x1100, 0x20, is_output=False, pdos=(), fixed_size=4),
                ),
            )
            for station in _STATIONS
        ]
        bus.image = self._image = BusImage(plan_image(slaves))
        bus.cycle = self._cycle = Cycle(bus.link, self._image, _ignore, knows_lrw=True)
        self._times: list[int] = []
        self._cycle.note_time = lambda time_ns, now_ns: self._times.append(time_ns)
        self._cycle.extra = [frmw(_STATIONS[0], Register.DC_SYSTEM_TIME, 8)]
        for station in _STATIONS:
            self._cycle.set_participation(station, Participation.ACTIVE)

    def exchange(self, now_ns: int) -> list[bytes]:
        """Start a cycle; return its frames."""
        if self._is_quiet and self._master.is_quiet(now_ns):
            frame = self._master.quiet_frame(now_ns)
            return [] if frame is None else [frame]
        self._master.handle_timeout(now_ns)
        self._master.start_cycle(now_ns)
        return self._master.frames_to_send(now_ns)

    def receive(self, frame: bytes, now_ns: int) -> tuple[bytes, CycleStats, Any]:
        """Take a frame; return all that may follow from it."""
        self._master.receive_frame(frame, now_ns)
        times, self._times = self._times, []
        return bytes(self._image.inputs), self._cycle.stats(), times

    def count(self) -> LinkStats:
        """Return the counters of the link."""
        return self._master.stats().link


def _ignore(now_ns: int) -> None:
    del now_ns


class _Pair:
    def __init__(self) -> None:
        self.sides = (_Side(is_quiet=True), _Side(is_quiet=False))
        self.now_ns = _MS


_PAIR = _Pair()


def fuzz_one(data: bytes) -> None:
    """Change the frame of a cycle by *data*, give it to both sides, and then the right one."""
    _PAIR.now_ns += 3000 * _MS if data[:1] == b"\xff" else _MS
    now_ns = _PAIR.now_ns
    sent = [side.exchange(now_ns) for side in _PAIR.sides]
    if sent[0] != sent[1]:
        raise AssertionError("the frames differ from those of the Python code")
    for frame in sent[0]:
        right = bytearray(frame)
        right[2 + 10 + 12] = 2 * 3  # two slaves that read and write
        wrong = bytearray(right)
        for at, value in zip(data[::2], data[1::2], strict=False):
            wrong[at % len(wrong)] ^= value
        for octets in (bytes(wrong[: len(wrong) - len(data) % 3]), bytes(right)):
            taken = [side.receive(octets, now_ns + len(data)) for side in _PAIR.sides]
            if taken[0] != taken[1]:
                raise AssertionError("inputs or counters differ from those of the Python code")
    if data[:1] > b"\xf0":
        counted = [side.count() for side in _PAIR.sides]
        if counted[0] != counted[1]:
            raise AssertionError("the counters of the link differ from those of the Python code")
