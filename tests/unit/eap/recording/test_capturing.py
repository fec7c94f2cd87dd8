"""Capture of samples and frames from memory that a test writes as an engine does."""

from __future__ import annotations

from time import monotonic_ns

import pytest

from eap.errors import ImageError
from eap.expressions import Condition
from eap.net.framering_file import FrameRingFile
from eap.net.image_file import create_image
from eap.pd.framering import SentFrame
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec
from eap.pd.words import RxWord, StationWord
from eap.recording.capture import (
    PortCapture,
    SampledVariable,
    StationCapture,
    count_of,
    find_name,
    frames_in,
    samples_in,
    unix_offset_ns,
)
from eap.recording.condition import ConditionWatch
from tests.support.samplingengine import SamplingEngine
from tests.unit.eap.conftest import left, right

MS = 1_000_000


@pytest.fixture
def engine(tmp_path):
    made = SamplingEngine(tmp_path / "left.image", left())
    made.run(5)
    yield made
    made.file.close()


def ticks(capture, look):
    value = SampledVariable(capture.image, "ticks")
    return [
        (cycle, time_ns, value.read(sample))
        for block in look.blocks
        for cycle, time_ns, sample in samples_in(block)
    ]


def test_capture_takes_every_cycle_with_its_time(engine):
    with StationCapture(engine.path) as capture:
        assert capture.look(7).blocks == []
        engine.run(4)
        look = capture.look(7)
        # The cycle that ran when it came may have begun before.
        assert ticks(capture, look) == [(n, n * 10 * MS + 7, n) for n in (7, 8, 9)]
        assert look.gaps == []
        (block,) = look.blocks
        assert (block.source, block.first_ns, block.last_ns) == ("left", 70 * MS + 7, 90 * MS + 7)
        engine.run(2)
        assert [cycle for cycle, _, _ in ticks(capture, capture.look(0))] == [10, 11]


def test_capture_takes_each_nth_cycle(engine):
    with StationCapture(engine.path, every=5) as capture:
        engine.run(17)
        look = capture.look(0)
        assert [cycle for cycle, _, _ in ticks(capture, look)] == [10, 15, 20]
        assert look.gaps == []


def test_two_captures_do_not_affect_each_other(engine):
    with StationCapture(engine.path) as one, StationCapture(engine.path) as other:
        engine.run(3)
        assert ticks(one, one.look(0)) == ticks(other, other.look(0)) != []


def test_slow_capture_counts_what_it_missed(engine):
    with StationCapture(engine.path) as capture:
        kept = engine.image.layout.samples.count
        engine.run(10)
        capture.look(0)
        for _ in range(3):
            engine.run(kept)
            engine.image.words[StationWord.SAMPLED_UNTIL] += kept
        look = capture.look(0)
        assert len(ticks(capture, look)) == kept
        assert [(gap.missing, gap.is_loss) for gap in look.gaps] == [(2 * kept, True)]
        engine.run(1)
        assert capture.look(0).gaps == []


def test_cycles_that_no_engine_ran_are_no_loss_of_the_recorder(engine):
    with StationCapture(engine.path) as capture:
        engine.run(5)
        capture.look(0)
        engine.image.words[StationWord.CYCLE] += 30
        engine.image.words[StationWord.RESTARTS] += 1
        engine.run(5)
        look = capture.look(0)
        assert len(ticks(capture, look)) == 5
        assert [(gap.missing, gap.is_loss) for gap in look.gaps] == [(30, False)]


def test_capture_follows_a_changed_station_without_a_gap(engine):
    with StationCapture(engine.path) as capture:
        engine.run(3)
        capture.look(0)
        engine.run(2)  # not read before the image is replaced
        engine.change(VariableSpec("more", "LINT"))
        assert not capture.follow(thoroughly=True)
        engine.run(2)
        assert len(ticks(capture, capture.look(0))) == 2
        assert capture.follow(thoroughly=False)
        assert "more" in capture.image.slots
        look = capture.look(0)
        assert len(ticks(capture, look)) == 2
        assert look.gaps == []
        assert not capture.follow(thoroughly=True)


def test_capture_without_an_image_is_refused(tmp_path):
    with pytest.raises(ImageError):
        StationCapture(tmp_path / "nobody.image")


def test_frames_come_with_port_direction_and_time(tmp_path):
    with (
        FrameRingFile(tmp_path / "frames.ring") as file,
        PortCapture(file_path(tmp_path)) as capture,
    ):
        assert file.header.is_wanted(monotonic_ns())
        writer = file.writer()
        assert [writer.number("left/eap0"), writer.number("right/eap0")] == [0, 1]
        writer.add_sent(0, 100, [SentFrame.of(0, memoryview(b"abc"))])
        writer.add(1, 200, 0, memoryview(b"defg"))
        assert capture.ports == ["left/eap0", "right/eap0"]
        (block,) = capture.look(1000).blocks
        assert [
            (time_ns, each.port, each.is_sent, each.frame)
            for time_ns, each in frames_in(block, [True, True])
        ] == [(1100, 0, True, b"abc"), (1200, 1, False, b"defg")]
        assert block.first_ns == 1100
        assert capture.look(0) == ([], [])


def file_path(folder):
    return folder / "frames.ring"


def test_frames_that_were_overwritten_are_counted(tmp_path):
    with FrameRingFile(file_path(tmp_path)) as file, PortCapture(file_path(tmp_path)) as capture:
        writer = file.writer()
        for _ in range(20_000):
            writer.add(0, 1, 0, memoryview(bytes(1000)))
        look = capture.look(0)
        (gap,) = look.gaps
        assert gap.is_loss
        assert gap.missing + sum(len(list(frames_in(b, [True]))) for b in look.blocks) == 20_000


def test_counters_of_a_station_are_sums_of_its_pds(tmp_path):
    with create_image(tmp_path / "r", plan_layout(right())) as file:
        image = file.image
        (slot,) = image.layout.rx
        image.words[slot.words + RxWord.LOST] = 4
        image.words[slot.words + RxWord.DISCARDED] = 2
        image.words[StationWord.DISCARDED + 1] = 1
        image.words[StationWord.OVERRUNS] = 9
        found = {name: count_of(image, name) for name in ("lost", "dropped", "overruns", "skipped")}
        assert found == {"lost": 4, "dropped": 3, "overruns": 9, "skipped": 0}
        with pytest.raises(ValueError, match="is no counter"):
            count_of(image, "cycle")


def test_names_of_a_condition_are_variables_or_counters(engine):
    images = {"left": engine.image}
    assert find_name(images, "lost") == (["left"], "lost", True)
    assert find_name(images, "left/lost") == (["left"], "lost", True)
    assert find_name(images, "left/setpoint[1]") == (["left"], "setpoint[1]", False)
    for name, problem in (
        ("loss", "'loss' is no counter"),
        ("lefft/ticks", "unknown station 'lefft'"),
        ("left/tick", "did you mean ticks"),
    ):
        with pytest.raises(ImageError, match=problem):
            find_name(images, name)


def test_condition_is_evaluated_for_each_cycle_and_for_grown_counters(engine, tmp_path):
    receiver = create_image(tmp_path / "right.image", plan_layout(right()))
    paths = {"left": engine.path, "right": tmp_path / "right.image"}
    (slot,) = receiver.image.layout.rx
    with receiver, ConditionWatch(Condition("left/ticks>=8 or right/lost"), paths) as watch:
        assert [is_true for _, is_true in watch.look(0)] == [False]
        engine.run(4)
        values = list(watch.look(0))
        assert [is_true for _, is_true in values[:-1]] == [False, True, True]
        assert values[0][0] == 70 * MS
    with receiver, ConditionWatch(Condition("lost>2"), paths) as watch:
        receiver.image.words[slot.words + RxWord.LOST] += 2
        assert [is_true for _, is_true in watch.look(0)] == [False]
        receiver.image.words[slot.words + RxWord.LOST] += 3
        assert [is_true for _, is_true in watch.look(0)] == [True]
        assert [is_true for _, is_true in watch.look(0)] == [False]


def test_distance_of_the_clocks_ignores_interrupted_readings(monkeypatch):
    # Readings of one clock, in order; 5 ms pass behind the first, and within the second try.
    clock = iter([100, 100 + 5 * MS, 6 * MS, 6 * MS + 20, 7 * MS, 12 * MS])
    unix = iter([10**18 + 150, 10**18 + 6 * MS + 10, 10**18 + 11 * MS])
    monkeypatch.setattr("eap.recording.capture.monotonic_ns", lambda: next(clock))
    monkeypatch.setattr("eap.recording.capture.time_ns", lambda: next(unix))
    assert unix_offset_ns() == 10**18
