"""The files of one recording: division, number kept, and disks that are full."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from eap.errors import EnvironmentalError
from eap.recording.capture import CapturedBlock, Gap
from eap.recording.disk import DiskThread
from eap.recording.files import ROOM_BYTES, DiskFullError, FileSequence, room_on
from eap.recording.header import EventKind, RecordingEvent

S = 1_000_000_000


class PlainFile:
    """A file of the blocks' bytes, which can be told to fail."""

    def __init__(self, path: Path, time_ns: int, failing: list[int]) -> None:
        self.path = path
        self.messages = 0
        self.lines = [f"began {time_ns // S}"]
        self._failing = failing
        self.is_whole = False
        path.write_bytes(b"")

    @property
    def size(self) -> int:
        return self.path.stat().st_size

    def write(self, block: CapturedBlock) -> None:
        if self._failing:
            raise OSError(self._failing.pop(), "failed")
        with self.path.open("ab") as file:
            file.write(block.data)
        self.messages += 1

    def add_gap(self, gap: Gap) -> None:
        self.lines.append(f"gap {gap.missing}")

    def add_event(self, event: RecordingEvent) -> None:
        self.lines.append(event.text)

    def flush(self) -> None:
        self.lines.append("flush")

    def close(self, time_ns: int) -> None:
        self.is_whole = True

    def abandon(self) -> None:
        self.lines.append("abandoned")


class Files:
    """A sequence, and the files that it opened."""

    def __init__(self, folder: Path, **options) -> None:
        self.opened: list[PlainFile] = []
        self.failing: list[int] = []
        options.setdefault("room", 0)
        self.sequence = FileSequence(folder / "line", ".dat", **options)

    def make(self, path: Path, time_ns: int) -> PlainFile:
        self.opened.append(PlainFile(path, time_ns, self.failing))
        return self.opened[-1]

    def record(self, seconds: range, size: int = 100) -> None:
        for second in seconds:
            if not self.sequence.is_open or self.sequence.is_due(second * S):
                self.sequence.open(self.make, second * S)
            self.sequence.write(CapturedBlock("a", second * S, second * S, bytes(size)))

    def names(self) -> list[str]:
        return sorted(each.name for each in self.sequence._base.parent.iterdir())


def test_one_file_has_no_number_and_its_followers_have(tmp_path):
    files = Files(tmp_path)
    files.sequence.open(files.make, 0)
    files.sequence.open(files.make, 0)
    files.sequence.close(0)
    assert files.names() == ["line-0002.dat", "line.dat"]
    assert all(each.is_whole for each in files.opened)
    assert not files.sequence.is_open


def test_files_are_divided_by_time_and_the_oldest_removed(tmp_path):
    files = Files(tmp_path, numbered=True, split_ns=10 * S, keep=3)
    files.record(range(95))
    files.sequence.close(95 * S)
    assert files.names() == ["line-0008.dat", "line-0009.dat", "line-0010.dat"]
    assert [each.lines[0] for each in files.opened[-2:]] == ["began 80", "began 90"]
    assert files.sequence.paths == [tmp_path / name for name in files.names()]
    assert files.sequence.messages == 95
    assert all(each.is_whole for each in files.opened)


def test_files_are_divided_by_size(tmp_path):
    files = Files(tmp_path, numbered=True, split_bytes=1000)
    files.record(range(35))
    files.sequence.close(0)
    assert [each.messages for each in files.opened] == [10, 10, 10, 5]
    assert files.sequence.octets == 3500


def test_day_of_recording_takes_no_more_than_the_files_kept(tmp_path):
    files = Files(tmp_path, numbered=True, split_ns=3600 * S, keep=4)
    largest = 0
    for minute in range(24 * 60):
        files.record(range(60 * minute, 60 * minute + 1), size=1000)
        largest = max(largest, sum(path.stat().st_size for path in tmp_path.iterdir()))
    files.sequence.close(0)
    assert len(files.opened) == 24
    assert len(files.names()) == 4
    assert largest <= 4 * 60 * 1000
    assert files.sequence.messages == 24 * 60


def test_name_that_exists_is_not_overwritten(tmp_path):
    (tmp_path / "line-0001.dat").write_bytes(b"precious")
    files = Files(tmp_path, numbered=True)
    files.record(range(1))
    assert files.sequence.paths == [tmp_path / "line-0002.dat"]
    assert (tmp_path / "line-0001.dat").read_bytes() == b"precious"


def test_disk_without_room_ends_the_recording_with_a_whole_file(tmp_path):
    files = Files(tmp_path)
    files.record(range(3))
    files.sequence.flush()
    files.sequence._room = 1 << 62
    with pytest.raises(DiskFullError, match=r"the disk is nearly full: .* MB left of .* stay free"):
        files.sequence.flush()
    files.sequence.close(0)
    assert files.opened[0].is_whole
    with pytest.raises(DiskFullError):
        files.sequence.open(files.make, 0)
    assert files.names() == ["line.dat"]


def test_write_that_fails_leaves_the_file_as_it_is(tmp_path):
    files = Files(tmp_path)
    files.record(range(2))
    files.failing += [errno.ENOSPC]
    with pytest.raises(DiskFullError, match="the disk is full"):
        files.record(range(2, 3))
    assert files.opened[0].lines[-1] == "abandoned"
    assert not files.sequence.is_open
    files.sequence.close(0)  # there is nothing any more
    assert files.sequence.messages == 2


def test_room_on_a_disk_is_a_share_of_it_but_not_of_a_large_one():
    assert room_on(0) == ROOM_BYTES
    assert room_on(100 << 20) == ROOM_BYTES + (5 << 20)
    assert room_on(1 << 40) == ROOM_BYTES + (100 << 20)


def test_disk_thread_writes_in_order_and_divides(tmp_path):
    files = Files(tmp_path, numbered=True, split_ns=10 * S)
    disk = DiskThread(files.sequence)
    disk.open(files.make, 0)
    for second in range(25):
        assert disk.write(CapturedBlock("a", second * S, second * S, b"x"))
    disk.add_event(RecordingEvent(time_ns=25 * S, kind=EventKind.MARK, text="door open"))
    disk.add_gap(Gap("a", 25 * S, 7, is_loss=True))
    disk.end(26 * S)
    assert [each.messages for each in files.opened] == [10, 10, 5]
    lines = [line for line in files.opened[-1].lines if line != "flush"]
    assert lines == ["began 20", "door open", "gap 7"]
    assert (disk.failure, files.opened[-1].is_whole) == ("", True)


def test_disk_thread_reports_its_first_failure_and_ends_in_order(tmp_path):
    files = Files(tmp_path)
    disk = DiskThread(files.sequence)
    disk.open(files.make, 0)
    files.failing += [errno.EIO]
    disk.write(CapturedBlock("a", 0, 0, b"x"))
    disk.write(CapturedBlock("a", 0, 0, b"y"))
    assert disk.close_file(0).wait(10)
    disk.end(0)
    assert "failed" in disk.failure
    assert files.opened[0].messages == 0


def test_disk_thread_reports_errors_of_any_kind(tmp_path):
    disk = DiskThread(Files(tmp_path).sequence)
    disk.open(lambda path, time_ns: 1 // (time_ns - time_ns), 0)
    disk.end(0)
    assert disk.failure.startswith("ZeroDivisionError")


def test_blocks_that_the_disk_cannot_take_in_time_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("eap.recording.disk.QUEUE_BYTES", 10)
    files = Files(tmp_path)
    disk = DiskThread(files.sequence)
    try:
        assert not disk.write(CapturedBlock("a", 0, 0, bytes(11)))
        assert disk.write(CapturedBlock("a", 0, 0, bytes(10)))
    finally:
        disk.end(0)


def test_sequence_that_continues_goes_on_behind_the_files_that_are_there(tmp_path):
    for name in ("line-0007.dat", "line-0009.dat", "line-10000.dat", "line-x.dat", "line.dat"):
        (tmp_path / name).write_bytes(b"old")
    files = Files(tmp_path, numbered=True, continues=True, keep=3)
    files.sequence.open(files.make, 0)
    assert [path.name for path in files.sequence.paths] == [
        "line-0009.dat",
        "line-10000.dat",
        "line-10001.dat",
    ]
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"line-0009.dat", "line-10000.dat", "line-10001.dat", "line-x.dat", "line.dat"}


def test_folder_that_is_missing_is_the_reason_that_a_file_cannot_be_opened(tmp_path):
    files = Files(tmp_path / "gone", numbered=True, continues=True)
    with pytest.raises(EnvironmentalError, match="gone: no such folder: make it"):
        files.sequence.open(files.make, 0)
    assert files.opened == []
