"""A day of recording in the time of a few seconds, on a disk of some megabytes."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import RawIOBase
from pathlib import Path

import pytest

from eap.pd.framering import HEADER_SIZE, FrameRingReader, FrameRingWriter, RingHeader
from eap.pd.layout import plan_layout
from eap.recording.capture import CapturedBlock
from eap.recording.files import DiskFullError, FileSequence, RecordingFile, room_on
from eap.recording.header import RecordingHeader
from eap.recording.recording_file import describe, open_recording
from eap.recording.sinks import FramesSink, ValuesSink
from tests.support.cyclic import station, written

pytestmark = pytest.mark.root

S = 10**9
START_NS = 1_700_000_000 * S
HOURS = 24
STEP_S = 10
DISK = 8 << 20
LAYOUT = plan_layout(station(variables=written(*(f"v{n}:LREAL" for n in range(100)))))
HEADER = RecordingHeader(plant="day", host="here", started_ns=START_NS)
SAMPLE = LAYOUT.samples.last - LAYOUT.samples.first


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(tmp_path)], check=True
    )
    yield tmp_path
    subprocess.run(["umount", str(tmp_path)], check=True)


def values(number: int, time_ns: int) -> CapturedBlock:
    """One sample of numbers that do not become smaller by compression."""
    data = number.to_bytes(8, "little") + time_ns.to_bytes(8, "little") + os.urandom(SAMPLE)
    return CapturedBlock(LAYOUT.station, time_ns, time_ns, data, SAMPLE)


def frames() -> Callable[[int, int], CapturedBlock]:
    memory = memoryview(bytearray(HEADER_SIZE + (1 << 20)))
    header = RingHeader.format(memory)
    header.capacity = 1 << 20
    writer, reader = FrameRingWriter(header, memory), FrameRingReader(header, memory)
    writer.number("s/eap0")

    def block(number: int, time_ns: int) -> CapturedBlock:
        writer.add(0, time_ns, 0, memoryview(os.urandom(900)))
        (run,) = reader.runs()
        return CapturedBlock("", time_ns, time_ns, run.octets)

    return block


def make_values(path: Path, time_ns: int) -> RecordingFile:
    return ValuesSink(path, HEADER, [LAYOUT], ())


def make_frames(path: Path, time_ns: int) -> RecordingFile:
    return FramesSink(path, HEADER, [LAYOUT], (), lambda: ["s/eap0"])


def record_day(
    files: FileSequence, make: Callable, block: Callable[[int, int], CapturedBlock]
) -> int:
    """Record a day, with a flush each minute; return the most bytes there were."""
    most = 0
    for number in range(HOURS * 3600 // STEP_S):
        time_ns = START_NS + number * STEP_S * S
        if not files.is_open or files.is_due(time_ns):
            files.open(make, time_ns)
        files.write(block(number, time_ns))
        if not number % 6:
            files.flush()
            most = max(most, sum(path.stat().st_size for path in files.paths))
    files.close(START_NS + HOURS * 3600 * S)
    return most


@pytest.mark.parametrize("kind", ["values", "frames"])
def test_day_of_recording_is_bounded_and_whole(disk: Path, kind: str) -> None:
    ending, make, block = _kind(kind)
    files = FileSequence(disk / "day", ending, numbered=True, split_ns=3600 * S, keep=4)
    most = record_day(files, make, block)
    assert most < DISK - room_on(DISK)
    left = sorted(disk.iterdir())
    assert left == files.paths
    assert [path.name[:8] for path in left] == [f"day-00{n}" for n in range(21, 25)]
    infos = [describe(path) for path in left]
    assert [(info.messages, info.finished, info.lost) for info in infos] == [(360, True, 0)] * 4
    assert files.messages == HOURS * 360


@pytest.mark.parametrize("kind", ["values", "frames"])
def test_small_disk_ends_the_recording_and_every_file_is_whole(disk: Path, kind: str) -> None:
    ending, make, block = _kind(kind)
    files = FileSequence(disk / "day", ending, numbered=True, split_ns=3600 * S)
    with pytest.raises(DiskFullError, match="the disk is nearly full"):
        record_day(files, make, block)
    files.close(START_NS)
    infos = [describe(path) for path in files.paths]
    assert len(infos) > 2
    assert all(info.finished for info in infos)
    assert sum(info.messages for info in infos) == files.messages


@pytest.mark.parametrize("kind", ["values", "frames"])
def test_disk_that_others_fill_leaves_files_that_can_be_read(disk: Path, kind: str) -> None:
    ending, make, block = _kind(kind)
    files = FileSequence(disk / "day", ending, numbered=True, room=0)
    files.open(make, START_NS)
    for number in range(600):
        files.write(block(number, START_NS + number * S))
    files.flush()
    with (disk / "others").open("wb", buffering=0) as others:
        _fill(others)
    with pytest.raises(DiskFullError, match="the disk is full"):
        _write_on(files, block)
    files.close(START_NS)
    recording = open_recording(files.paths[0])
    assert 600 <= recording.messages <= files.messages


def _fill(file: RawIOBase) -> None:
    with suppress(OSError):
        while True:
            file.write(bytes(4096))


def _write_on(files: FileSequence, block: Callable[[int, int], CapturedBlock]) -> None:
    for number in range(600, 10_000):
        files.write(block(number, START_NS + number * S))
        files.flush()


def _kind(kind: str) -> tuple[str, Callable, Callable[[int, int], CapturedBlock]]:
    return (
        (".mcap", make_values, values) if kind == "values" else (".pcapng", make_frames, frames())
    )
