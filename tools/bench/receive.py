"""Cost of one frame and one record inside the process, without a socket."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic_ns, perf_counter_ns

from eap.codec.ams import AmsHeader
from eap.codec.datatypes import parse
from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import CYCLE_OFFSET, PdFrameHeader, PdHeader, encode_frame, iter_pds
from eap.codec.structures import lay_out_structure
from eap.codec.wire import WireStruct
from eap.ids import InterfaceUri, NetId
from eap.net.image_file import create_image
from eap.net.loopback import LoopbackLines
from eap.pd.layout import plan_layout
from eap.pd.link import FrameHandler
from eap.pd.station import Station
from tools.bench.figures import Figure, at_most, report
from tools.bench.machine import memory_folder
from tools.bench.settings import Settings
from tools.bench.stations import CYCLE_US, PUBLISHER, Shape, publishing, subscribing

TITLE = "Inside the process: a frame of known layout beside a naive walk; records"
_CALLS = 5000
_OF_BLOCK = 1.1
"""Largest ratio of a struct to a block; below 1.1 it is the noise of two equal runs."""
_BUFFER_SIZE = 2048
_CYCLE = struct.Struct("<H")
_SHAPES = (Shape(1, 1, 600), Shape(1, 10, 60), Shape(1, 100, 6))
_RECORDS: tuple[WireStruct, ...] = (
    EtherCatHeader(100),
    PdFrameHeader(NetId.parse(PUBLISHER), 1, 0),
    PdHeader(1, 2, 3, 4),
    AmsHeader(NetId.parse(PUBLISHER), 851, NetId.parse(PUBLISHER), 32800, 2, 4, 0),
)


class _Nowhere:
    """An origin that is never used."""

    def source_of(self, data: memoryview) -> bytes:
        """Return an address, as a socket does."""
        del data
        return b"\x7f\0\1\1"

    def sender_of(self, data: memoryview) -> str:
        """Return no destination."""
        del data
        return ""


_NOWHERE = _Nowhere()


def run(settings: Settings) -> list[Figure]:
    """Measure the receive path for three layouts, and each record both ways."""
    settings.tell("receive path and records")
    figures = [_frame(shape, settings.micro_repeats) for shape in _SHAPES]
    figures += _struct(settings.micro_repeats)
    for record in _RECORDS:
        decode = _best(_repeat(type(record).decode, record.encode()), settings.micro_repeats)
        encode = _best(_repeat(record.encode), settings.micro_repeats)
        name = f"{type(record).__name__}, {record.SIZE} bytes"
        figures.append(report(name, f"decode {decode:.0f} ns, encode {encode:.0f} ns"))
    return figures


def _frame(shape: Shape, repeats: int) -> Figure:
    data = bytearray(_octets(shape).ljust(_BUFFER_SIZE, b"\0"))
    with TemporaryDirectory(dir=memory_folder()) as folder:
        spec = subscribing(shape, "none")
        with create_image(Path(folder) / "image", plan_layout(spec)) as file:
            station = Station(spec, file.image, file.wake_waiters)
            station.start(monotonic_ns())
            learned = _best(_receiving(station.handlers["eap0"], data, shape), repeats)
            naive = _best(_walking(file.image.memory, data[: shape.frame_size], shape), repeats)
    name = f"{shape.pds} PDs in a frame: learned layout, ratio to a naive walk that only copies"
    detail = f"{learned:.0f} to {naive:.0f} ns"
    if shape.pds == 1:
        return report(name, f"{learned / naive:.2f} ({detail})", learned / naive)
    return at_most(name, learned / naive, 1, "", detail)


def _struct(repeats: int) -> list[Figure]:
    """Compare a PD of a struct with one of a raw block of as many bytes, sent and received."""
    members = [(f"m{n}", parse("INT" if n % 2 else "LREAL")) for n in range(125)]
    kind = lay_out_structure("ST_Bench", members)
    shapes = [Shape(1, 1, kind.size), Shape(1, 1, kind.size, kind.text)]
    lines = LoopbackLines()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(dir=memory_folder())))
        received: list[Callable[[], int]] = []
        sent: list[Callable[[], int]] = []
        for shape in shapes:
            for spec in (subscribing(shape, "none"), publishing(shape, "none")):
                path = folder / f"{spec.name}{len(received)}"
                file = stack.enter_context(create_image(path, plan_layout(spec)))
                station = Station(spec, file.image, file.wake_waiters)
                if spec.subscriptions:
                    station.start(monotonic_ns())
                    data = bytearray(_octets(shape).ljust(_BUFFER_SIZE, b"\0"))
                    received.append(_receiving(station.handlers["eap0"], data, shape))
                else:
                    station.connect("eap0", lines.open(InterfaceUri("loop", path.name)))
                    station.start(monotonic_ns())
                    sent.append(_cycling(station))
    return [
        _beside_block(f"PD of a struct of {kind.size} bytes, {what}", runs, repeats)
        for what, runs in (("received", received), ("cycle that sends it", sent))
    ]


def _beside_block(name: str, runs: Sequence[Callable[[], int]], repeats: int) -> Figure:
    # By turns, so that what disturbs one of them disturbs the other too.
    times = [[run_once() for run_once in runs] for _ in range(2 * repeats)]
    block, ours = (min(each) / _CALLS for each in zip(*times, strict=True))
    detail = f"{ours:.0f} to {block:.0f} ns"
    return at_most(f"{name}, ratio to a block", ours / block, _OF_BLOCK, "", detail)


def _cycling(station: Station) -> Callable[[], int]:
    at_ns = monotonic_ns()

    def run_once() -> int:
        nonlocal at_ns
        begin = perf_counter_ns()
        for _ in range(_CALLS):
            at_ns += CYCLE_US * 1000
            station.cycle(at_ns, at_ns)
        return perf_counter_ns() - begin

    return run_once


def _receiving(take: FrameHandler, data: bytearray, shape: Shape) -> Callable[[], int]:
    """Return a run of the product's receive path: match, check, copy, counters."""
    view, put, size = memoryview(data), _CYCLE.pack_into, shape.frame_size
    cycle = 0

    def run_once() -> int:
        nonlocal cycle
        at_ns = monotonic_ns()
        begin = perf_counter_ns()
        for _ in range(_CALLS):
            cycle += 1
            at_ns += CYCLE_US * 1000
            put(view, CYCLE_OFFSET, cycle & 0xFFFF)
            take(view, size, at_ns, _NOWHERE)
        return perf_counter_ns() - begin

    return run_once


def _walking(memory: memoryview, data: bytearray, shape: Shape) -> Callable[[], int]:
    """Return a run of a walk from header to header that looks up and copies each PD."""
    places = {1 + n: slice(n * shape.size, (n + 1) * shape.size) for n in range(shape.pds)}
    target = memoryview(bytearray(len(memory)))

    def run_once() -> int:
        begin = perf_counter_ns()
        for _ in range(_CALLS):
            for header, payload in iter_pds(data):
                target[places[header.pd_id]] = payload
        return perf_counter_ns() - begin

    return run_once


def _octets(shape: Shape) -> bytes:
    header = PdFrameHeader(NetId.parse(PUBLISHER), shape.pds, 0)
    pds = [(PdHeader(1 + n, 0, shape.size), bytes(shape.size)) for n in range(shape.pds)]
    return encode_frame(header, pds)


def _repeat(call: Callable[..., object], *arguments: object) -> Callable[[], int]:
    def run_once() -> int:
        begin = perf_counter_ns()
        for _ in range(_CALLS):
            call(*arguments)
        return perf_counter_ns() - begin

    return run_once


def _best(run_once: Callable[[], int], repeats: int) -> float:
    """Return nanoseconds a call of the fastest run: what disturbs only ever makes it slower."""
    return min(run_once() for _ in range(repeats)) / _CALLS
