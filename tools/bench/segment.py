"""The simulated segment alone: what one frame of process data costs, and how slaves add up."""

from __future__ import annotations

from time import perf_counter_ns

import msgspec

from devicebus.master.master import Master
from devicebus.sim.devices.build import build_segment
from devicebus.sim.segment import SegmentEnd, SimulatedSegment
from devicebus.sim.spec import BusSpec
from tools.bench.buses import bus
from tools.bench.figures import Figure, report
from tools.bench.settings import Settings

TITLE = "Simulated segment alone: frames of 512 bytes of process data, all slaves in OP"
SLAVES = (1, 4, 16, 32, 64)
OCTETS = 512
_FRAMES = 200
_CYCLE_NS = 1_000_000
_TRIP_NS = 20_000


def run(settings: Settings) -> list[Figure]:
    """Measure each size; the frame is what a master in OP sends every cycle."""
    figures = []
    for slaves in SLAVES:
        settings.tell(f"segment of {slaves} slaves")
        took_ns = _measure(slaves, settings.micro_repeats)
        detail = f"{took_ns / 1000:.0f} µs each, {took_ns / 1000 / slaves:.1f} µs a slave"
        text = f"{1e9 / took_ns:.0f} cycles/s ({detail})"
        figures.append(report(f"{slaves} slaves", text, 1e9 / took_ns))
    return figures


def _measure(slaves: int, repeats: int) -> float:
    """Return nanoseconds a frame of the fastest run."""
    segment = build_segment(msgspec.convert(bus(slaves, OCTETS), BusSpec))
    frame, now_ns = _operate(segment)
    best = float("inf")
    for _ in range(repeats):
        begin = perf_counter_ns()
        for _ in range(_FRAMES):
            now_ns += _CYCLE_NS
            segment.process_frame(bytearray(frame), now_ns)
        best = min(best, (perf_counter_ns() - begin) / _FRAMES)
    return best


def _operate(segment: SimulatedSegment) -> tuple[bytes, int]:
    """Bring *segment* to OP on a virtual clock; return the frame of a cycle, and the time.

    Raises:
        RuntimeError: the frame does not come back as it should.
    """
    master = Master()
    now_ns = next_ns = _CYCLE_NS
    task = master.bring_up(now_ns)
    while not task.is_done:
        if now_ns >= next_ns:
            master.start_cycle(now_ns)
            next_ns = now_ns + _CYCLE_NS
        now_ns = _exchange(master, segment, master.frames_to_send(now_ns), now_ns)
    task.result()
    master.start_cycle(now_ns)
    frames = master.frames_to_send(now_ns)
    good = _good(master)
    now_ns = _exchange(master, segment, frames, now_ns)
    if _good(master) != good + 1:
        raise RuntimeError(f"a cycle of {len(segment.slaves)} slaves came back wrong")
    return frames[0], now_ns  # process data goes first


def _exchange(master: Master, segment: SimulatedSegment, frames: list[bytes], now_ns: int) -> int:
    """Let *frames* go round; return the time."""
    now_ns += _TRIP_NS
    for frame in frames:
        octets = bytearray(frame)
        if segment.process_frame(octets, now_ns) is SegmentEnd.PRIMARY:
            master.receive_frame(octets, now_ns)
    master.handle_timeout(now_ns)
    return now_ns


def _good(master: Master) -> int:
    cycle = master.stats().cycle
    return cycle.good if cycle is not None else 0
