"""Recordings read again, whole, cut anywhere, and damaged."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from eap.errors import ConfigError, LocalProtocolError, MalformedError
from eap.recording.frames_reader import FramesFile
from eap.recording.recording_file import describe, iso_time, open_recording
from eap.recording.repair import finish_recording
from eap.recording.rows import TimeWindow, plain_value, select
from eap.recording.values_reader import ValuesFile
from tests.support.examples import examples
from tests.support.recordings import (
    CYCLE_NS,
    PUBLISHED,
    T0,
    begin_frames,
    begin_values,
    sample,
    write_frames,
    write_values,
)


def f32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


@pytest.fixture(scope="module")
def values(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_values(tmp_path_factory.mktemp("values") / "a.mcap")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_frames(tmp_path_factory.mktemp("frames") / "a.pcapng")


def test_values_are_read_in_the_order_of_their_times(values: Path) -> None:
    recording = ValuesFile(values)
    rows = list(recording.rows())
    assert [row.time_ns for row in rows] == sorted(row.time_ns for row in rows)
    first, second = recording.sources
    own = [row for row in rows if row.source == first]
    assert [row.cycle for row in own] == list(range(300))
    messages = recording.messages_of(first)
    size = len(sample(0))
    assert [messages.sample(row.values, size) for row in own] == [sample(n) for n in range(300)]
    assert [row.values for row in rows if row.source == second] == [[n] for n in range(0, 300, 2)]


@pytest.mark.parametrize(
    ("writer", "write", "name"),
    [
        ("values_writer", write_values, "later.mcap"),
        ("frames_writer", write_frames, "later.pcapng"),
    ],
)
def test_recording_of_a_later_format_is_refused_with_its_release(
    writer: str,
    write: Callable[[Path], Path],
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"eap.recording.{writer}.FORMAT", "2")
    monkeypatch.setattr(f"eap.recording.{writer}.RELEASE", "7.1")
    path = write(tmp_path / name)
    with pytest.raises(MalformedError, match=r"of format 2, .* use the release .* \(7\.1\)"):
        open_recording(path)


def test_columns_are_parts_of_variables(values: Path) -> None:
    recording = ValuesFile(values)
    source = recording.sources[2]
    assert [column.name for column in source.columns] == [
        f"island-01/{name}"
        for name in (
            "temp", "count", "axis.position", "axis.on", "list[0]", "list[1]", "mode", "raw", "name"
        )
    ]  # fmt: skip
    assert source.columns[0].unit == "°C"
    row = next(recording.rows(TimeWindow(T0 + 3 * CYCLE_NS)))
    plain = [
        plain_value(column.kind, value)
        for column, value in zip(source.columns, row.values, strict=True)
    ]
    assert plain == [1.0, 3, -3, True, 3, -3, "On", "030102", "n3"]


def test_window_of_values_has_both_ends(values: Path) -> None:
    rows = ValuesFile(values).rows(TimeWindow(T0 + 100 * CYCLE_NS, T0 + 102 * CYCLE_NS), {2})
    assert [row.cycle for row in rows] == [100, 101, 102]


def test_values_of_frames_are_those_of_the_sender(frames: Path) -> None:
    recording = FramesFile(frames)
    rows = list(recording.rows())
    own = [row for row in rows if row.source == 0]
    assert [row.time_ns for row in own] == [T0 + n * CYCLE_NS for n in range(300)]
    assert [row.values for row in own] == [[f32(n / 3), n] for n in range(300)]
    bits = [row.values for row in rows if row.source == 1]
    assert bits == [[bool(n & 1), n >> 1 & 7] for n in range(300)]


def test_values_of_received_frames_count_once_without_the_sender(tmp_path: Path) -> None:
    # Two receivers, and the sender's port was not recorded.
    writer = begin_frames(tmp_path / "a.pcapng", 3)
    writer.close(T0)
    content = (tmp_path / "a.pcapng").read_bytes().replace(b"island-01/eap0", b"island-07/eap0")
    (tmp_path / "b.pcapng").write_bytes(content)
    rows = list(FramesFile(tmp_path / "b.pcapng").rows(sources={0}))
    assert [row.cycle for row in rows] == [0, 1, 2]


def test_capture_of_another_program_needs_the_pds_of_a_plant(frames: Path) -> None:
    recording = open_recording(frames, PUBLISHED[:0])
    assert len(recording.sources) == 2
    assert isinstance(open_recording(frames, PUBLISHED), FramesFile)


def test_info_of_values(values: Path) -> None:
    info = describe(values)
    assert (info.kind, info.messages, info.lost, info.finished) == ("values", 450, 4, True)
    assert (info.from_, info.until) == (iso_time(T0), iso_time(T0 + 299 * CYCLE_NS))
    assert info.variables[:3] == ["island-01/temp", "island-01/count", "island-01/axis"]
    assert info.variables[-1] == "island-02/temp"
    assert info.types["island-01/temp"].unit == "°C"
    assert (info.plant, info.files, info.recording) == ("mill", ["mill.yaml"], False)
    assert [(event.kind, event.text) for event in info.events] == [
        ("mark", "door open"),
        ("lost", ""),
    ]


def test_info_of_frames(frames: Path) -> None:
    info = describe(frames)
    assert (info.kind, info.messages, info.lost, info.finished) == ("frames", 600, 7, True)
    assert info.from_ == "2023-11-14T22:13:20.000000000Z"
    assert info.variables == ["island-01/temp", "island-01/count", "island-01/a", "island-01/b"]
    assert info.interfaces == ["island-02/eap0", "island-01/eap0"]
    assert (info.plant, info.files) == ("mill", ["mill.yaml"])
    assert [event.text for event in info.events] == ["door open", ""]


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\x89MCAP0\r", b"\n\r\r\n" + bytes(30)], ids=repr
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(MalformedError, match="x at offset"):
        describe(tmp_path / "x")


def test_mcap_file_of_another_program_is_refused(tmp_path: Path, values: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(values.read_bytes()[:8])
    with pytest.raises(MalformedError, match="no recording of eapctl"):
        describe(tmp_path / "x.mcap")


def test_killed_recording_of_values_is_read_and_finished(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    writer = begin_values(path, 1000)
    shutil.copy(path, cut)
    assert describe(path).recording
    with pytest.raises(LocalProtocolError, match="is being recorded"):
        finish_recording(path)
    writer.close()
    info = describe(cut)
    assert (info.finished, info.recording) == (False, False)
    cycles = [row.cycle for row in ValuesFile(cut).rows(sources={2})]
    assert cycles == list(range(len(cycles)))
    assert len(cycles) > 1000 - 100
    finish_recording(cut)
    assert describe(cut).finished
    assert [row.cycle for row in ValuesFile(cut).rows(sources={2})] == cycles
    with cut.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        found = [m.sequence for _, _, m in reader.iter_messages(topics=["island-01"])]
        names = [each.name for each in reader.iter_attachments()]
    assert found == cycles
    assert names == ["published.json", "mill.yaml"]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.channel_message_counts[2] == len(cycles)
    content = cut.read_bytes()
    assert finish_recording(cut) == 0
    assert cut.read_bytes() == content


@given(st.integers(0, 60_000))
@examples(40)
def test_values_cut_anywhere_are_a_prefix(
    tmp_path_factory: pytest.TempPathFactory, values: Path, size: int
) -> None:
    path = tmp_path_factory.mktemp("cut") / "a.mcap"
    octets = values.read_bytes()
    path.write_bytes(octets[: size % len(octets)])
    try:
        finish_recording(path)
        cycles = [row.cycle for row in ValuesFile(path).rows(sources={2})]
    except MalformedError:
        assert size % len(octets) < 1500  # the header is cut
        return
    assert cycles == list(range(len(cycles)))
    with path.open("rb") as file:
        assert len(list(make_reader(file).iter_messages(topics=["island-01"]))) == len(cycles)


@given(st.integers(0, 1 << 20))
@examples(40)
def test_frames_cut_anywhere_are_a_prefix(
    tmp_path_factory: pytest.TempPathFactory, frames: Path, size: int
) -> None:
    path = tmp_path_factory.mktemp("cut") / "a.pcapng"
    octets = frames.read_bytes()
    path.write_bytes(octets[: size % len(octets)])
    try:
        finish_recording(path)
        cycles = [row.cycle for row in FramesFile(path).rows(sources={0})]
    except MalformedError:
        assert size % len(octets) < 2000
        return
    assert cycles == list(range(len(cycles)))
    assert FramesFile(path).is_finished


@given(st.data())
def test_damage_anywhere_raises_nothing_unexpected(
    tmp_path_factory: pytest.TempPathFactory, values: Path, frames: Path, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "file"
    content = bytearray(data.draw(st.sampled_from((values, frames))).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        list(open_recording(path).rows())
        describe(path)
    except MalformedError as exc:
        assert str(exc)  # noqa: PT017  refused in words


def test_time_that_no_calendar_has_is_a_number() -> None:
    assert iso_time(10**21) == "1000000000000000000000 ns"
    assert iso_time(253_402_300_799 * 10**9 + 5) == "9999-12-31T23:59:59.000000005Z"


def test_damaged_chunk_costs_its_values_and_is_counted(tmp_path: Path) -> None:
    path = write_values(tmp_path / "a.mcap", 1000)
    chunk = ValuesFile(path)._content.chunks[3]
    content = bytearray(path.read_bytes())
    content[chunk.data_offset + chunk.data_size // 2] ^= 0xFF
    path.write_bytes(content)
    recording = ValuesFile(path)
    cycles = [row.cycle for row in recording.rows(sources={2})]
    assert len(cycles) in range(900, 920)
    assert recording.damaged_chunks == 1


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        (["island-01/temp"], {"island-01/temp"}),
        (["temp"], {"island-01/temp", "island-02/temp"}),
        (["island-02"], {"island-02/temp"}),
        (["island-01/list"], {"island-01/list[0]", "island-01/list[1]"}),
        (["island-01/list[1]", "axis.on"], {"island-01/list[1]", "island-01/axis.on"}),
        (["*/axis"], {"island-01/axis.on", "island-01/axis.position"}),
        (["island-0?/t*"], {"island-01/temp", "island-02/temp"}),
    ],
)
def test_patterns_select_columns(values: Path, patterns: list[str], names: set[str]) -> None:
    found = select(ValuesFile(values).sources, patterns)
    assert {column.name for chosen in found.values() for column in chosen.values()} == names


def test_pattern_without_a_variable_suggests_one(values: Path) -> None:
    sources = ValuesFile(values).sources
    with pytest.raises(ConfigError, match="no recorded variable 'island-01/tmp', did you mean"):
        select(sources, ["island-01/tmp"])
    with pytest.raises(ConfigError, match=r"'zzz'; recorded variables: island-01/temp, .* and 4"):
        select(sources, ["zzz"])


def test_frames_damaged_before_their_end_are_not_cut_off(tmp_path: Path, frames: Path) -> None:
    octets = bytearray(frames.read_bytes())
    middle = len(octets) // 8 * 4
    octets[middle : middle + 400] = bytes(400)
    path = tmp_path / "hole.pcapng"
    path.write_bytes(octets)
    with pytest.raises(MalformedError, match=r"packets follow at \d+: nothing is cut"):
        finish_recording(path)
    assert path.read_bytes() == octets


def test_values_damaged_before_their_end_are_not_cut_off(tmp_path: Path) -> None:
    path, hole = tmp_path / "a.mcap", tmp_path / "hole.mcap"
    writer = begin_values(path, 500)
    octets = path.read_bytes() + b"\xff" * (5 << 20)
    writer.close()
    hole.write_bytes(octets)
    with pytest.raises(MalformedError, match=r"damaged, and \d+ bytes follow: nothing is cut"):
        finish_recording(hole)
    assert hole.stat().st_size == len(octets)
    # As a power cut may leave it.
    hole.write_bytes(octets.rstrip(b"\xff") + bytes(5 << 20))
    assert finish_recording(hole) == 5 << 20
    assert describe(hole).finished
