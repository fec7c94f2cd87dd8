"""Small recordings of both kinds, with known values."""

from __future__ import annotations

import struct
from pathlib import Path

from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from eap.recording.frames_writer import FramesWriter, udp_wrapping
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import RecordedVariable, pack_closely
from eap.recording.published import RecordedFrame, RecordedPd
from eap.recording.values_writer import ValuesWriter

T0 = 1_700_000_000_000_000_000
CYCLE_NS = 10_000_000
VARIABLES = (
    RecordedVariable("temp", "REAL", "°C"),
    RecordedVariable("count", "UINT"),
    RecordedVariable("axis", "Axis<8/4:position@0 DINT,on@4 BOOL>"),
    RecordedVariable("list", "INT[2]"),
    RecordedVariable("name", "STRING(6)"),
    RecordedVariable("mode", "E_Mode<INT:Off=0,On=1>"),
    RecordedVariable("raw", "BLOCK(3)"),
)
PUBLISHED = (
    RecordedFrame(
        station="island-01",
        port="eap0",
        publisher="127.0.1.1.2.1",
        interface="udp://127.0.1.1",
        name="out",
        destination="127.0.1.2",
        pds=(
            RecordedPd(name="pd101", pd_id=101, version=1, size=6, variables=VARIABLES[:2]),
            RecordedPd(
                name="pd102",
                pd_id=102,
                version=1,
                size=1,
                variables=(RecordedVariable("a", "BOOL"), RecordedVariable("b", "BIT3")),
            ),
        ),
    ),
)


def sample(cycle: int) -> bytes:
    """Values of VARIABLES in *cycle*, packed closely."""
    return struct.pack(
        "<fHiB3xhh6sh3s",
        cycle / 3,
        cycle & 0xFFFF,
        -cycle,
        cycle & 1,
        cycle,
        -cycle,
        f"n{cycle}".encode()[:6],
        cycle & 1,
        bytes([cycle & 0xFF, 1, 2]),
    )


def header() -> RecordingHeader:
    return RecordingHeader(
        plant="mill",
        host="pc",
        started_ns=T0,
        options={"every": "1"},
        files=(AttachedFile("mill.yaml", b"plant: mill\n"),),
        published=PUBLISHED,
    )


def begin_values(path: Path, cycles: int = 300) -> ValuesWriter:
    """Write *cycles* of two stations, a mark and a loss, and leave the file open."""
    writer = ValuesWriter(path, header())
    first = writer.add_station("island-01", pack_closely(VARIABLES))
    second = writer.add_station("island-02", pack_closely(VARIABLES[:1]))
    for cycle in range(cycles):
        at_ns = T0 + cycle * CYCLE_NS
        writer.write(first, cycle, at_ns, sample(cycle))
        if cycle % 2:
            # The recorder reads its stations in turn: this one is behind.
            writer.write(second, cycle - 1, at_ns - CYCLE_NS, struct.pack("<f", cycle - 1))
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.MARK, text="door open"))
    writer.add_event(
        RecordingEvent(time_ns=T0 + 5, kind=EventKind.LOST, station="island-01", count=4)
    )
    return writer


def write_values(path: Path, cycles: int = 300) -> Path:
    begin_values(path, cycles).close()
    return path


def frame(cycle: int, publisher: str = "127.0.1.1.2.1") -> bytes:
    """A frame of PUBLISHED."""
    return encode_frame(
        PdFrameHeader(NetId.parse(publisher), 2, cycle & 0xFFFF),
        [
            (PdHeader(101, 1, 0, 3), struct.pack("<fH", cycle / 3, cycle & 0xFFFF)),
            (PdHeader(102, 1, 0, 0), bytes([cycle & 0xF])),
        ],
    )


def begin_frames(path: Path, cycles: int = 300) -> FramesWriter:
    """Write *cycles* as the sender's port sent them and another port received them."""
    writer = FramesWriter(path, header())
    receiver = writer.add_interface("island-02/eap0", "udp://127.0.1.2")
    sender = writer.add_interface("island-01/eap0", "udp://127.0.1.1")
    wrapping = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980))
    for cycle in range(cycles):
        packet = wrapping.wrap(frame(cycle))
        at_ns = T0 + cycle * CYCLE_NS
        writer.write(sender, at_ns, packet, outbound=True)
        writer.write(receiver, at_ns + 1000, packet, outbound=False)
    return writer


def write_frames(path: Path, cycles: int = 300) -> Path:
    writer = begin_frames(path, cycles)
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.MARK, text="door open"))
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.LOST, count=7), 1)
    writer.close(T0 + cycles * CYCLE_NS)
    return path
