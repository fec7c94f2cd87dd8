"""Recordings of values and of frames: raw, and valid ones with bytes changed or cut off."""

from __future__ import annotations

import struct
import tempfile
from contextlib import suppress
from itertools import islice
from pathlib import Path

from eap.errors import MalformedError
from eap.recording.frames_writer import FramesWriter, udp_wrapping
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import RecordedVariable, pack_closely
from eap.recording.recording_file import describe, open_recording
from eap.recording.values_writer import ValuesWriter

_T0 = 1_700_000_000_000_000_000
_FRAME = bytes.fromhex("0c40 7f0001010201 0000 0100 0000")
_MOST_ROWS = 1000


def _header() -> RecordingHeader:
    file = AttachedFile("mill.yaml", b"plant: mill\n")
    return RecordingHeader(plant="mill", host="pc", started_ns=_T0, files=(file,))


def _recordings() -> tuple[bytes, ...]:
    with tempfile.TemporaryDirectory() as folder:
        values, frames = Path(folder, "a.mcap"), Path(folder, "a.pcapng")
        writer = ValuesWriter(values, _header())
        places = [RecordedVariable("temp", "REAL"), RecordedVariable("name", "STRING(4)")]
        station = writer.add_station("mill", pack_closely(places))
        for cycle in range(3):
            writer.write(station, cycle, _T0 + cycle, struct.pack("<f4s", cycle, b"ab"))
        writer.add_event(RecordingEvent(time_ns=_T0, kind=EventKind.MARK, text="open"))
        writer.close()
        capture = FramesWriter(frames, _header())
        port = capture.add_interface("mill/eap0", "udp://127.0.1.1")
        wrapping = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980))
        for cycle in range(3):
            capture.write(port, _T0 + cycle, wrapping.wrap(_FRAME), outbound=True)
        capture.close(_T0 + 3)
        return values.read_bytes(), frames.read_bytes()


_VALID = _recordings()


def fuzz_one(data: bytes) -> None:
    """A recording is described and its rows are read, or it is called damaged."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a")
        for content in (data, *(_bent(valid, data) for valid in _VALID)):
            path.write_bytes(content)
            with suppress(MalformedError):
                describe(path)
                for _ in islice(open_recording(path).rows(), _MOST_ROWS):
                    pass


def _bent(valid: bytes, data: bytes) -> bytes:
    """Change bytes of *valid* at places that *data* names; sometimes cut it off."""
    bent = bytearray(valid)
    for at in range(0, len(data) - 2, 3):
        bent[int.from_bytes(data[at : at + 2], "little") % len(bent)] = data[at + 2]
    return bytes(bent[: -len(data)] if len(data) % 4 == 1 else bent)
