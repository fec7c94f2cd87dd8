"""Recordings, read by the programs that people open them with."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import MacAddr, NetId
from eap.ops.recordings import ExportRequest, export_recording
from eap.recording.frames_writer import FramesWriter, ethernet_wrapping, udp_wrapping
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from tests.support.recordings import write_values
from tests.support.tshark import dissect

pytestmark = pytest.mark.tshark

T0 = 1_700_000_000_123_456_789
PUBLISHER = NetId.parse("127.0.1.1.2.1")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two ports, UDP and Ethernet with a VLAN tag, a mark, a loss, a plant file of 200 kB."""
    path = tmp_path_factory.mktemp("frames") / "a.pcapng"
    plant = AttachedFile("mill.yaml", b"plant: m\xc3\xbchle\n" + b"# comment\n" * 20_000)
    header = RecordingHeader(plant="mill", host="pc", started_ns=T0, files=(plant,))
    writer = FramesWriter(path, header)
    udp = writer.add_interface("island-01/eap0", "udp://127.0.1.1")
    ethernet = writer.add_interface("island-01/eap1", "ethernet://eth0")
    by_udp = udp_wrapping(("127.0.1.1", 34980), ("127.0.1.2", 34980))
    by_ethernet = ethernet_wrapping(
        MacAddr.parse("02:00:00:00:00:01"), MacAddr.parse("01:01:05:04:00:00"), vlan=0xE003
    )
    for size in range(8):
        frame = encode_frame(
            PdFrameHeader(PUBLISHER, 1, 100 + size),
            [(PdHeader(101, 1, 0, 0), bytes(range(size)))],
        )
        writer.write(udp, T0 + 2 * size, by_udp.wrap(frame), outbound=True)
        writer.write(ethernet, T0 + 2 * size + 1, by_ethernet.wrap(frame), outbound=False)
        if size == 3:
            writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.MARK, text="door open"))
            writer.add_event(RecordingEvent(time_ns=T0, kind=EventKind.LOST, count=5), udp)
    writer.close(T0 + 100)
    return path


def test_tshark_dissects_every_frame(recording: Path) -> None:
    packets = dissect(recording)
    assert [packet["cycle"] for packet in packets] == [100 + n // 2 for n in range(16)]
    assert {packet["publisher"] for packet in packets} == {str(PUBLISHER)}
    assert [packet["transport"] for packet in packets[:2]] == ["udp", "ethernet"]
    assert not any(packet["malformed"] for packet in packets)
    assert packets[15]["pds"] == [
        {"id": 101, "version": 1, "length": 7, "quality": 0, "data": "00010203040506"}
    ]


def test_tshark_shows_interfaces_times_directions_and_marks(recording: Path) -> None:
    names = ("interface_name", "time_epoch", "packet_flags_direction", "comment")
    fields = [part for name in names for part in ("-e", f"frame.{name}")]
    command = ["tshark", "-n", "-r", str(recording), "-T", "fields", *fields]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows = [line.split("\t") for line in done.stdout.splitlines()]
    assert [row[0] for row in rows[:2]] == ["island-01/eap0", "island-01/eap1"]
    assert rows[1][1].endswith(".123456790")
    assert [int(row[2], 0) for row in rows[:2]] == [2, 1]
    assert [number for number, row in enumerate(rows) if "door open" in row[3]] == [8]


def test_capinfos_counts_frames_and_shows_the_plant_file(recording: Path) -> None:
    done = subprocess.run(["capinfos", str(recording)], capture_output=True, text=True, check=True)
    assert "Number of packets:   16" in done.stdout
    assert "eap-file mill.yaml 1/4" in done.stdout
    assert "Ethernet" in done.stdout


def test_pandas_reads_csv_and_parquet_alike(tmp_path: Path) -> None:
    values = write_values(tmp_path / "a.mcap")
    for form in ("csv", "parquet"):
        export_recording(ExportRequest(file=values, form=form), print)
    import pandas as pd

    from_csv = pd.read_csv(tmp_path / "a.csv")
    from_parquet = pd.read_parquet(tmp_path / "a.parquet")
    assert list(from_csv.columns) == list(from_parquet.columns)
    assert len(from_csv) == len(from_parquet) == 300
    for name in ("time_ns", "island-01/temp", "island-01/count", "island-01/list[1]"):
        as_read = from_csv[name].astype(from_parquet[name].dtype)
        assert as_read.to_numpy().tobytes() == from_parquet[name].to_numpy().tobytes()
    assert from_csv["island-02/temp"].isna().sum() == 150
