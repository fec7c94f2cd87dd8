"""Replays: frames of both kinds of recordings, their times and counters, another station."""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from eap.codec.pd import PD_FRAME_START, PdFrameHeader, PdHeader, encode_frame, iter_pds
from eap.errors import ConfigError
from eap.ids import NetId
from eap.recording.frames_reader import FramesFile
from eap.recording.header import RecordingHeader
from eap.recording.messages import RecordedVariable, pack_closely
from eap.recording.published import RecordedFrame, RecordedPd
from eap.recording.recording_file import open_recording
from eap.recording.replay import (
    ReplayClock,
    ReplayFrame,
    ReplaySender,
    frames_of,
    impersonate,
    senders_of,
)
from eap.recording.values_reader import ValuesFile
from eap.recording.values_writer import ValuesWriter
from tests.support.recordings import CYCLE_NS, PUBLISHED, T0, frame, write_frames

MS = 1_000_000


def test_recorded_frames_are_those_that_the_sender_sent(tmp_path: Path) -> None:
    left_out: dict[str, str] = {}
    found = list(frames_of(FramesFile(write_frames(tmp_path / "a.pcapng", 20)), left_out))
    assert [each.data for each in found] == [frame(n) for n in range(20)]
    assert {each.destination for each in found} == {"127.0.1.2:34980"}
    assert found[0].sender == ReplaySender("island-01", "eap0", "udp://127.0.1.1", "127.0.1.1.2.1")
    assert found[0].names == ("pd101", "pd102")
    assert left_out == {}


@pytest.mark.parametrize(
    ("only", "count"),
    [("island-01", 5), ("island-01/eap0", 5), ("*/pd102", 5), ("127.0.1.1.2.1", 5), ("x*", 0)],
)
def test_only_chooses_frames(tmp_path: Path, only: str, count: int) -> None:
    recording = FramesFile(write_frames(tmp_path / "a.pcapng", 5))
    assert len(list(frames_of(recording, {}, only))) == count


def pd(name: str, number: int, period_us: int, *variables: RecordedVariable) -> RecordedPd:
    return RecordedPd(
        name=name, pd_id=number, version=1, size=4, variables=variables, period_us=period_us
    )


def values(path: Path, frames: tuple[RecordedFrame, ...], *names: str) -> ValuesFile:
    """60 cycles of 10 ms: ``a`` changes each cycle, ``b`` every 20."""
    writer = ValuesWriter(
        path, RecordingHeader(plant="p", host="h", started_ns=T0, published=frames)
    )
    station = writer.add_station("s", pack_closely(RecordedVariable(n, "UDINT") for n in names))
    for cycle in range(60):
        sample = b"".join(struct.pack("<I", {"a": cycle, "b": cycle // 20}[n]) for n in names)
        writer.write(station, 7 + cycle, T0 + cycle * CYCLE_NS, sample)
    writer.close()
    recording = open_recording(path)
    assert isinstance(recording, ValuesFile)
    return recording


A, B = RecordedVariable("a", "UDINT"), RecordedVariable("b", "UDINT")


def published(name: str, *pds: RecordedPd) -> RecordedFrame:
    return RecordedFrame(
        station="s", port="eap0", publisher="1.2.3.4.5.6", interface="udp://127.0.0.1",
        name=name, destination="127.0.0.2", pds=pds,
    )  # fmt: skip


def test_values_become_frames_at_the_period_or_on_change(tmp_path: Path) -> None:
    frames = (published("fast", pd("p1", 1, 20_000, A)), published("rare", pd("p2", 2, 0, B)))
    found = list(frames_of(values(tmp_path / "a.mcap", frames, "a", "b"), {}))
    fast = [each for each in found if each.names == ("p1",)]
    rare = [each for each in found if each.names == ("p2",)]
    assert [each.at_ns for each in fast] == [T0 + n * 20 * MS for n in range(30)]
    assert [each.at_ns for each in rare] == [T0, T0 + 200 * MS, T0 + 400 * MS]
    publisher = NetId.parse("1.2.3.4.5.6")
    assert fast[3].data == encode_frame(
        PdFrameHeader(publisher, 1, 13), [(PdHeader(1, 1, 0, 0), struct.pack("<I", 6))]
    )
    assert rare[0].sender.interface == "udp://127.0.0.1"


def test_pd_with_a_variable_that_was_not_recorded_is_left_out(tmp_path: Path) -> None:
    frames = (published("out", pd("p1", 1, 10_000, A), pd("p2", 2, 10_000, B)),)
    left_out: dict[str, str] = {}
    found = list(frames_of(values(tmp_path / "a.mcap", frames, "a"), left_out))
    assert left_out == {"s/p2": "b was not recorded"}
    assert [[p.pd_id for p, _ in iter_pds(each.data)] for each in found] == [[1]] * 60


def test_frames_as_another_station_have_its_netid(tmp_path: Path) -> None:
    recording = FramesFile(write_frames(tmp_path / "a.pcapng", 3))
    other = ReplaySender("island-09", "eap0", "udp://127.0.1.9", "127.0.1.9.2.1")
    senders = senders_of(PUBLISHED) | {other.publisher: other}
    found = list(impersonate(frames_of(recording, {}), "island-09", senders))
    assert [each.data for each in found] == [frame(n, "127.0.1.9.2.1") for n in range(3)]
    assert all(each.packet.endswith(each.data) for each in found)
    assert found[0].sender is other
    with pytest.raises(ConfigError, match="unknown station 'island-08', did you mean island-0"):
        list(impersonate(frames_of(recording, {}), "island-08", senders))


def test_frames_of_several_stations_are_not_sent_as_one() -> None:
    frames = [replayed(0, 1, "a"), replayed(1, 1, "b")]
    with pytest.raises(ConfigError, match="frames of a and b: choose those of one"):
        list(impersonate(frames, "a", {"1.1.1.1.1.1": frames[0].sender}))


def replayed(at_ms: float, cycle: int, station: str = "a") -> ReplayFrame:
    sender = ReplaySender(station, "eap0", "udp://127.0.0.1", "1.1.1.1.1.1")
    data = encode_frame(PdFrameHeader(NetId.parse(sender.publisher), 0, cycle), [])
    return ReplayFrame(round(at_ms * MS), sender, "127.0.0.2", data, b"", ())


def cycle_of(data: bytes) -> int:
    return PdFrameHeader.decode(data, PD_FRAME_START).cycle


@pytest.mark.parametrize(("rate", "step_ms"), [(1, 10), (2, 5), (0.5, 20)])
def test_clock_keeps_distances_over_the_end_of_a_round(rate: float, step_ms: int) -> None:
    frames = [replayed(500 + 10 * n, 100 + n) for n in range(5)]
    clock = ReplayClock(rate)
    found: list[tuple[int, Any]] = []
    for _ in range(3):
        clock.begin_round(1_000 * MS)
        found += [(clock.due_ns(each), cycle_of(clock.numbered(each))) for each in frames]
    times = [at for at, _ in found]
    assert times[0] == 1_000 * MS
    assert {later - earlier for earlier, later in pairwise(times)} == {step_ms * MS}
    assert [cycle for _, cycle in found] == list(range(100, 115))


def test_clock_numbers_cycles_beyond_16_bits() -> None:
    frames = [replayed(20 * n, (65_530 + 2 * n) & 0xFFFF) for n in range(4)]
    clock = ReplayClock(1)
    cycles = []
    for _ in range(2):
        clock.begin_round(0)
        cycles += [cycle_of(clock.numbered(each)) for each in frames if clock.due_ns(each) >= 0]
    assert cycles == [65_530, 65_532, 65_534, 0, 2, 4, 6, 8]


def test_clock_repeats_a_single_frame_once_a_second() -> None:
    clock = ReplayClock(2)
    times = []
    for _ in range(3):
        clock.begin_round(0)
        times.append(clock.due_ns(replayed(700, 1)))
    assert times == [0, 500 * MS, 1_000 * MS]
