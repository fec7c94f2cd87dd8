"""Barriers between words and data, on processors that need them."""

from __future__ import annotations

import threading

import pytest

from eap.compiled import cyclic
from eap.pd import compiledplan, ordering
from eap.pd.image import ImageSamples, Inputs
from eap.pd.spec import LinkSpec, RxPdSpec, Writer
from eap.pd.station import Station
from eap.pd.words import StationWord
from tests.support.cyclic import MS, PEER, image_of, octets, received, station, written

SPEC = station(
    variables=(*written("x:UINT"), *received("a:UINT", "b:UINT")),
    links=(LinkSpec("a", "b"),),
    subscriptions=(RxPdSpec("a", "eap0", 1, ("a",), PEER),),
)


@pytest.fixture
def seen(monkeypatch):
    """Parity of the words that guard the regions of engine and application, at each barrier."""
    parities: list[tuple[int, int]] = []
    image = image_of(SPEC)

    def note() -> None:
        words = image.words
        engine, application = StationWord.ENGINE_SEQUENCE, StationWord.APPLICATION_SEQUENCE
        parities.append((words[engine] & 1, words[application] & 1))

    monkeypatch.setattr(compiledplan, "_cyclic", None)
    monkeypatch.setattr(ordering, "REORDERS", True)
    monkeypatch.setattr(ordering, "keep_order", note)
    return image, parities


def test_writers_have_a_barrier_behind_the_odd_word_and_before_the_even_one(seen):
    image, parities = seen
    with image.writing(Writer.APPLICATION):
        parities.append("data")
        image.write("x", 1)
    assert parities == [(0, 1), "data", (0, 1)]


def test_cycle_has_barriers_around_its_counter_and_around_its_region(seen):
    image, parities = seen
    made = Station(SPEC, image, lambda: None)
    made.start(0)
    made.cycle(MS, MS)
    assert parities[:2] == [(0, 0), (1, 0)]
    assert parities[-2:] == [(1, 0), (0, 0)]


def test_frame_between_two_cycles_has_a_barrier_on_both_sides_of_its_data(seen):
    image, parities = seen
    made = Station(SPEC, image, lambda: None)
    made.start(0)
    frame = memoryview(octets([(1, b"\1\0")]))

    class Origin:
        def source_of(self, data):
            return b""

    made.handlers["eap0"](frame, len(frame), 1, Origin())
    assert parities == [(1, 0), (1, 0)]
    assert image.read("a") == 1


def test_readers_have_a_barrier_before_and_behind_their_copy(seen):
    image, parities = seen
    for read in (lambda: image.read("x"), image.try_snapshot, Inputs(image).refresh):
        parities.clear()
        read()
        assert len(parities) >= 2
    parities.clear()
    ImageSamples(image).read(1)
    assert len(parities) == 1


def test_barrier_of_the_compiled_part_and_that_without_it_can_be_called_by_all_threads():
    choices = [ordering._choose(reorders=True), ordering.order_by_lock, ordering.keep_order]
    assert choices[0] is (ordering.order_by_lock if cyclic is None else cyclic.keep_order)
    assert ordering._choose(reorders=False) is not choices[0]
    failed: list[BaseException] = []

    def call() -> None:
        try:
            for _ in range(300):
                for keep_order in choices:
                    keep_order()
        except RuntimeError as exc:
            failed.append(exc)

    threads = [threading.Thread(target=call) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
