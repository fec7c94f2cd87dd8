"""MCAP files: read by the mcap library and protobuf, whole and killed."""

from __future__ import annotations

import json
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import RecordedVariable, pack_closely
from eap.recording.values_writer import EVENTS, ValuesWriter

T0 = 1_700_000_000_000_000_000
MS = 1_000_000
PLACED = pack_closely([RecordedVariable("temp", "REAL", "°C"), RecordedVariable("n", "UINT")])


def header() -> RecordingHeader:
    return RecordingHeader(
        plant="mill",
        host="pc",
        started_ns=T0,
        options={"every": "1"},
        files=(AttachedFile("mill.yaml", b"plant: mill\n"),),
    )


def write(path: Path, cycles: int) -> ValuesWriter:
    writer = ValuesWriter(path, header())
    station = writer.add_station("island-01", PLACED)
    for cycle in range(cycles):
        writer.write(station, cycle, T0 + cycle * 10 * MS, struct.pack("<fH", cycle / 2, cycle))
    return writer


def test_mcap_library_reads_values_events_and_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = write(path, 300)
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.MARK, text="door open"))
    writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.LOST, station="island-01", count=4))
    writer.close()
    assert writer.lost == 4
    assert writer.messages == 300
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        rows = [
            (message.log_time, message.sequence, read.cycle_number, read.temp, read.n)
            for _, _, message, read in reader.iter_decoded_messages(topics=["island-01"])
        ]
        events = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=[EVENTS])]
        attached = {each.name: each.data for each in reader.iter_attachments()}
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
    assert rows == [(T0 + n * 10 * MS, n, n, n / 2, n) for n in range(300)]
    assert [(e["kind"], e["text"], e["count"]) for e in events] == [
        ("mark", "door open", 0),
        ("lost", "", 4),
    ]
    assert attached == {"published.json": b"[]", "mill.yaml": b"plant: mill\n"}
    assert metadata["eap"]["plant"] == "mill"
    assert metadata["eap"]["every"] == "1"


def test_killed_recorder_loses_at_most_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = write(path, 550)
    # The file as another process finds it: what is in our memory is not there.
    octets = path.read_bytes()
    writer.close()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(octets)
    found = []
    with cut.open("rb") as file, suppress(McapError):
        for _, _, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            found.append(message.sequence)
    assert found == list(range(len(found)))
    assert len(found) >= 450


def test_values_writer_leaves_an_existing_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        ValuesWriter(path, header())
    assert path.read_bytes() == b"precious"


def test_abandoned_file_keeps_what_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = write(path, 10)
    writer.flush()
    size = path.stat().st_size
    writer.abandon()
    assert path.stat().st_size == size == len(path.read_bytes())
