"""One recording, look by look, of an appliance whose engine is the test."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from eap.net.framering_file import FrameRingFile
from eap.pd.spec import VariableSpec
from eap.pd.words import StationWord
from eap.recording import recorder as module
from eap.recording.recorder import Attachment, Recorder, RecorderOptions
from eap.recording.recording_file import describe, open_recording
from eap.runtime.folder import ApplianceFolder, ApplianceInfo
from tests.support.samplingengine import SamplingEngine
from tests.unit.eap.conftest import left

S = 1_000_000_000
UNIX_AT_0 = 1_700_000_000 * S


class Recorded:
    """An appliance of one station, and recorders of it."""

    def __init__(self, folder: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("EAP_RUNTIME_DIR", str(folder))
        monkeypatch.setattr(module, "unix_offset_ns", lambda: self.offset_ns)
        self.offset_ns = UNIX_AT_0
        self.folder = ApplianceFolder.claim("demo")
        self.engine = SamplingEngine(self.folder.image("left"), left())
        self.other = SamplingEngine(
            self.folder.image("other"), msgspec.structs.replace(left(), name="other")
        )
        for engine in (self.engine, self.other):
            engine.run(5)
        self.ring = FrameRingFile(self.folder.frames)
        (out / "demo.yaml").write_text("plant: demo\n")
        self.folder.write_info(
            ApplianceInfo(
                "demo", str(out / "demo.yaml"), ["left", "other"], "2026-11-23T00:00:00Z", 1
            )
        )
        self.out = out
        self.now_ns = 0
        self.recorders: list[Recorder] = []

    def record(self, **options) -> Recorder:
        options.setdefault("kind", "values")
        options.setdefault("patterns", ("left",))
        given = RecorderOptions(
            name="x",
            base=str(self.out / "x"),
            plant="demo",
            folder=str(self.folder.path),
            **options,
        )
        self.recorders.append(Recorder(given, self.now_ns))
        self.look()
        self.look()
        return self.recorders[-1]

    def look(self) -> None:
        for recorder in self.recorders:
            recorder.look(self.now_ns)

    def run(self, cycles: int) -> None:
        """Run cycles, with a look after each tenth."""
        for number in range(cycles):
            self.engine.run()
            self.now_ns = self.engine.image.words[0] * 10_000_000
            if number % 10 == 9:
                self.look()
        self.look()

    def files(self) -> list[Path]:
        return [Path(each) for each in self.recorders[-1].check(self.now_ns).files]

    def close(self) -> None:
        for recorder in self.recorders:
            recorder.end("closed", self.now_ns)
        self.ring.close()
        self.engine.file.close()
        self.other.file.close()
        self.folder.close()


@pytest.fixture
def recorded(tmp_path, tmp_path_factory, monkeypatch):
    made = Recorded(tmp_path_factory.mktemp("r"), tmp_path, monkeypatch)
    yield made
    made.close()


def ticks(path: Path, station: str = "left") -> list[int]:
    recording = open_recording(path)
    (source,) = (n for n, each in recording.sources.items() if each.station == station)
    names = [each.name for each in recording.sources[source].columns]
    rows = recording.rows(sources={source})
    return [row.values[names.index(f"{station}/ticks")] for row in rows]


def test_recorder_writes_all_cycles_from_its_begin_to_its_end(recorded):
    recorder = recorded.record(patterns=("left/ticks",))
    recorded.run(50)
    recorder.end("stopped", recorded.now_ns)
    assert ticks(recorded.files()[0]) == list(range(7, 56))
    state = recorder.check(recorded.now_ns)
    assert (state.state, state.reason, state.lost, state.failed) == ("ended", "stopped", 0, False)


def test_recorder_without_its_patterns_waits_with_the_reason(recorded):
    recorder = recorded.record(patterns=("left/gone",))
    assert (recorder.state.state, recorder.is_settled) == ("waiting", True)
    assert "select no variable" in recorder.state.reason


def test_clock_that_is_set_begins_another_file_in_which_times_grow(recorded):
    recorder = recorded.record()
    recorded.run(20)
    recorded.offset_ns -= 3600 * S
    recorded.run(20)
    recorder.end("stopped", recorded.now_ns)
    first, second = (describe(each) for each in recorded.files())
    assert first.messages + second.messages == 39
    assert (first.lost, second.lost) == (0, 0)
    assert second.until < first.from_
    assert [each.text for each in second.events] == [
        "the clock of this host was set by -3600.000 s"
    ]


def test_stations_that_change_at_once_keep_their_values(recorded, monkeypatch):
    recorder = recorded.record(patterns=())
    both = (recorded.engine, recorded.other)
    for engine in both:
        engine.run(10)
    recorded.look()
    more = VariableSpec("more", "LINT")
    recorded.engine.change(more)
    find = Attachment._image_files

    def change_other(attachment: Attachment) -> list[int]:
        """The other one changes behind the look, with two cycles that were not read yet."""
        if recorded.other.spec.variables[0] != more:
            recorded.other.run(2)
            recorded.other.change(more)
            recorded.other.spec = msgspec.structs.replace(
                recorded.other.spec, variables=(more, *recorded.other.spec.variables)
            )
        return find(attachment)

    monkeypatch.setattr(Attachment, "_image_files", change_other)
    for _ in range(3):
        recorded.look()
        for engine in both:
            engine.run(4)
    recorder.end("stopped", recorded.now_ns)
    for station, engine in zip(("left", "other"), both, strict=True):
        found = [tick for path in recorded.files() for tick in ticks(path, station)]
        assert found == list(range(7, engine.image.words[StationWord.CYCLE] + 1))
    assert "other/more" in describe(recorded.files()[-1]).variables


def test_ring_is_written_around_the_moment_of_its_condition(recorded):
    recorder = recorded.record(when="left/ticks==300", ring_ns=2 * S, before_ns=S, after_ns=S // 2)
    recorded.run(400)
    assert recorder.state.state == "armed"
    recorder.end("stopped", recorded.now_ns)
    (path,) = recorded.files()
    found = ticks(path)
    assert found == list(range(found[0], found[-1] + 1))
    assert 190 <= found[0] <= 200
    assert 350 <= found[-1] <= 360


def test_condition_may_become_true_again_and_again(recorded):
    recorder = recorded.record(
        when="left/ticks==100 or left/ticks==120 or left/ticks==300",
        ring_ns=S,
        before_ns=S // 10,
        after_ns=S // 2,
    )
    recorded.run(400)
    recorder.end("stopped", recorded.now_ns)
    first, second = (describe(each) for each in recorded.files())
    assert [each.kind for each in first.events] == ["trigger", "trigger"]
    assert 0.79 <= first.seconds <= 0.95
    assert [each.kind for each in second.events] == ["trigger"]
    assert recorder.check(recorded.now_ns).triggers == 3


def test_recorder_counts_and_writes_what_it_missed(recorded):
    recorder = recorded.record()
    recorded.run(10)
    kept = recorded.engine.image.layout.samples.count
    recorded.engine.run(kept)
    recorded.run(1)
    recorder.end("stopped", recorded.now_ns)
    assert recorder.state.lost == 1
    info = describe(recorded.files()[0])
    assert info.lost == 1
    assert [(each.kind, each.count) for each in info.events] == [("lost", 1)]


def test_appliance_that_ends_ends_the_file_and_is_waited_for(recorded):
    recorder = recorded.record()
    recorded.run(10)
    recorded.folder.close()
    state = recorder.check(recorded.now_ns)
    assert (state.state, state.reason) == ("waiting", "the plant does not run")
    recorder.end("stopped", recorded.now_ns)
    assert describe(recorded.files()[0]).finished


def test_disk_that_is_full_ends_the_recording(recorded):
    recorder = recorded.record(room=1 << 62)
    for _ in range(1000):
        recorded.run(1)
        if recorder.is_over:
            break
        recorder._disk.close_file(0).wait(1)
    state = recorder.check(recorded.now_ns)
    assert (state.state, state.failed) == ("ended", True)
    assert state.reason.startswith("the disk is nearly full")
    assert state.files == []
