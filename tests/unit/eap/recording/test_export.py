"""Exports: the same values in every form, bit by bit."""

from __future__ import annotations

import csv
import struct
from pathlib import Path

import pytest
from msgspec import structs
from pyarrow import parquet

from eap.errors import ConfigError
from eap.ops.recordings import ExportRequest, ExportResult, export_recording
from eap.recording.export import write_csv
from eap.recording.frames_reader import FramesFile
from eap.recording.mcap_file import McapFile
from eap.recording.messages import RecordedVariable
from eap.recording.parquet import write_parquet
from eap.recording.published import RecordedPd
from eap.recording.recording_file import describe, open_recording
from eap.recording.rows import ALL, select
from tests.support.recordings import CYCLE_NS, PUBLISHED, T0, sample, write_frames, write_values

BYTE, BLOCK = RecordedVariable("byte", "USINT"), RecordedVariable("block", "BLOCK(5)")


@pytest.fixture(scope="module")
def values(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_values(tmp_path_factory.mktemp("values") / "a.mcap")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("frames") / "a.pcapng")


def export(file: Path, form: str, target: Path, *variables: str, **more: object) -> ExportResult:
    request = ExportRequest(file=file, form=form, target=target, variables=variables, **more)
    return export_recording(request, print)


def cells(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_csv_has_a_row_a_time_and_a_column_a_value(values: Path, tmp_path: Path) -> None:
    result = export(values, "csv", tmp_path / "a.csv")
    assert (result.rows, result.columns) == (300, 10)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0].startswith("time_ns,island-01/temp,island-01/count,island-01/axis.position,")
    rows = cells(tmp_path / "a.csv")
    assert rows[3] == {
        "time_ns": str(T0 + 3 * CYCLE_NS),
        "island-01/temp": "1.0",
        "island-01/count": "3",
        "island-01/axis.position": "-3",
        "island-01/axis.on": "1",
        "island-01/list[0]": "3",
        "island-01/list[1]": "-3",
        "island-01/mode": "On",
        "island-01/raw": "030102",
        "island-01/name": "n3",
        "island-02/temp": "",
    }
    assert rows[4]["island-02/temp"] == "4.0"
    for number, row in enumerate(rows):
        octets = struct.pack("<f", float(row["island-01/temp"]))
        assert octets == sample(number)[:4]


def test_csv_quotes_texts_that_need_it(tmp_path: Path) -> None:
    from eap.recording.header import RecordingHeader
    from eap.recording.messages import RecordedVariable, pack_closely
    from eap.recording.values_writer import ValuesWriter

    writer = ValuesWriter(tmp_path / "a", RecordingHeader(plant="p", host="h", started_ns=0))
    station = writer.add_station("s", pack_closely([RecordedVariable("t", "STRING(8)")]))
    texts = ["", "a,b", 'say "x"', "a\nb", "ü"]
    for number, text in enumerate(texts):
        writer.write(station, number, T0 + number, text.encode().ljust(8, b"\0"))
    writer.close()
    export(tmp_path / "a", "csv", tmp_path / "a.csv")
    assert [row["s/t"] for row in cells(tmp_path / "a.csv")] == texts


def test_parquet_has_the_types_of_the_variables(values: Path, tmp_path: Path) -> None:
    export(values, "parquet", tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet")
    assert [str(field.type) for field in table.schema] == [
        "int64", "float", "uint16", "int32", "bool", "int16", "int16", "string",
        "fixed_size_binary[3]", "string", "float",
    ]  # fmt: skip
    assert table.schema.field("island-01/temp").metadata == {b"unit": "°C".encode()}
    assert table.schema.metadata[b"eap.plant"] == b"mill"
    columns = table.to_pydict()
    assert columns["time_ns"] == [T0 + n * CYCLE_NS for n in range(300)]
    assert b"".join(struct.pack("<f", each) for each in columns["island-01/temp"]) == b"".join(
        sample(n)[:4] for n in range(300)
    )
    assert columns["island-02/temp"] == [n if n % 2 == 0 else None for n in range(300)]
    assert columns["island-01/raw"][5] == bytes([5, 1, 2])
    assert columns["island-01/mode"][:2] == ["Off", "On"]


def test_mcap_of_a_part_has_the_same_samples_and_events(values: Path, tmp_path: Path) -> None:
    whole, part = tmp_path / "whole.mcap", tmp_path / "part.mcap"
    assert export(values, "mcap", whole).rows == 450
    before, after = open_recording(values), open_recording(whole)
    assert list(before.rows()) == list(after.rows())
    assert (after.events, after.files) == (before.events, before.files)
    assert after.published == PUBLISHED
    assert describe(whole).finished
    export(values, "mcap", part, "island-01/list", begin="+1s", end="+1s")
    rows = list(open_recording(part).rows())
    assert [row.values for row in rows] == [[n, -n] for n in range(100, 201)]


def test_mcap_of_frames_has_the_values_of_the_pds(frames: Path, tmp_path: Path) -> None:
    export(frames, "mcap", tmp_path / "a.mcap")
    export(frames, "csv", tmp_path / "direct.csv")
    export(tmp_path / "a.mcap", "csv", tmp_path / "again.csv")
    assert (tmp_path / "direct.csv").read_text() == (tmp_path / "again.csv").read_text()
    assert len(cells(tmp_path / "direct.csv")) == 300
    assert describe(tmp_path / "a.mcap").variables == describe(frames).variables
    export(frames, "mcap", tmp_path / "b.mcap", "island-01/b")
    assert {tuple(row.values) for row in open_recording(tmp_path / "b.mcap").rows()} == {
        (n,) for n in range(8)
    }


def test_pcapng_of_a_part_keeps_packets_directions_and_events(frames: Path, tmp_path: Path) -> None:
    part = tmp_path / "part.pcapng"
    result = export(frames, "pcapng", part, "island-01/temp", begin="+1s", end="+11ms")
    assert result.rows == 4
    whole = list(FramesFile(frames).frames())
    kept = list(FramesFile(part).frames())
    assert [each.data for each in kept] == [each.data for each in whole[200:204]]
    assert [each.captured.outbound for each in kept] == [True, False, True, False]
    assert [each.captured.at_ns for each in kept] == [
        each.captured.at_ns for each in whole[200:204]
    ]
    export(frames, "pcapng", tmp_path / "whole.pcapng")
    again = FramesFile(tmp_path / "whole.pcapng")
    assert again.events == FramesFile(frames).events
    assert list(again.rows()) == list(FramesFile(frames).rows())


@pytest.mark.parametrize(
    ("form", "name", "more", "message"),
    [
        ("pcapng", "x", {}, "has no frames"),
        ("mcap", "a.mcap", {"is_forced": True}, "is the recording itself"),
        ("csv", "there", {}, "exists: overwrite it with --force"),
        ("csv", "x", {"variables": ("nothing",)}, "no recorded variable 'nothing'"),
        ("csv", "x", {"begin": "soon"}, "'soon' is no time"),
        ("parquet", "-", {}, "not written to stdout"),
    ],
)
def test_export_refuses_what_cannot_be(
    tmp_path: Path, form: str, name: str, more: dict[str, object], message: str
) -> None:
    values = write_values(tmp_path / "a.mcap", 3)
    (tmp_path / "there").write_text("precious")
    target = Path(name) if name == "-" else tmp_path / name
    with pytest.raises(ConfigError, match=message):
        export_recording(ExportRequest(file=values, form=form, target=target, **more), print)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.mcap", "there"]
    assert (tmp_path / "there").read_text() == "precious"


def test_capture_of_another_program_needs_a_plant(frames: Path, tmp_path: Path) -> None:
    content = frames.read_bytes().replace(b"eap-published", b"eap-forgotten")
    (tmp_path / "a.pcapng").write_bytes(content)
    with pytest.raises(ConfigError, match="has no variables: name the plant file"):
        export(tmp_path / "a.pcapng", "csv", tmp_path / "a.csv")


def test_pds_of_a_plant_file_give_a_capture_its_variables(tmp_path: Path) -> None:
    from eap.ops.recordings import published_in

    published = published_in(Path("config/demo.yaml"))
    assert {frame.station for frame in published} == {"island-01", "island-02", "island-03"}
    assert all(frame.pds and frame.pds[0].variables for frame in published)


def test_variable_in_several_pds_has_one_cell(frames: Path, tmp_path: Path) -> None:
    # The counter of the first PD is the first two bytes of the second one, too.
    (frame,) = PUBLISHED
    twice = RecordedPd(name="x", pd_id=102, version=1, size=1, variables=(BYTE,))
    first = RecordedPd(name="y", pd_id=101, version=1, size=6, variables=(BLOCK, BYTE))
    frame = structs.replace(frame, pds=(first, twice))
    recording = FramesFile(frames, (frame,))
    selection = select(recording.sources, [])
    write_parquet(recording, ALL, selection, tmp_path / "a.parquet")
    table = parquet.read_table(tmp_path / "a.parquet").to_pydict()
    assert table["island-01/byte"] == [n & 0xF for n in range(300)]
    lines: list[str] = []
    write_csv(recording, ALL, selection, lines.append)
    assert len(lines) == 301
    assert lines[20].endswith(",3\n")


def test_export_of_a_damaged_recording_has_the_number_of_its_damaged_chunks(
    values: Path, tmp_path: Path
) -> None:
    octets = bytearray(values.read_bytes())
    octets[McapFile(values).chunks[-1].data_offset + 9] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(octets)
    result = export(damaged, "csv", tmp_path / "a.csv")
    assert result.rows < 300
    assert result.damaged_chunks == 1
    assert export(values, "csv", tmp_path / "b.csv").damaged_chunks == 0
