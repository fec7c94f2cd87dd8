"""The ring of recorded frames, without files: writer and readers over one buffer."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.errors import ImageError
from eap.pd.framering import (
    HEADER_SIZE,
    RECORDING_TERM_NS,
    FrameRingReader,
    FrameRingWriter,
    RingHeader,
    RingWord,
    SentFrame,
    records_in,
)

CAPACITY = 1024


class Ring:
    def __init__(self, capacity=CAPACITY) -> None:
        self.memory = memoryview(bytearray(HEADER_SIZE + capacity))
        self.header = RingHeader.format(self.memory)
        self.header.capacity = capacity
        self.writer = self.open()

    def open(self) -> FrameRingWriter:
        return FrameRingWriter(RingHeader(self.memory), self.memory)

    def reader(self) -> FrameRingReader:
        return FrameRingReader(RingHeader(self.memory), self.memory)

    def add(self, *frames, port=0):
        if len(frames) > 1:
            self.writer.add_sent(port, 0, [SentFrame.of(0, memoryview(each)) for each in frames])
        else:
            self.writer.add(port, 0, 0, memoryview(frames[0]))


def taken(reader):
    """Return the frames since the last call, and how many were missed."""
    runs = list(reader.runs())
    return [each.frame for run in runs for each in records_in(run.octets)], sum(
        run.lost for run in runs
    )


def test_reader_gets_what_is_written_after_it_came():
    ring = Ring()
    ring.add(b"before")
    reader = ring.reader()
    assert taken(reader) == ([], 0)
    ring.writer.add(3, 77, 0x2_7F000101_0000, memoryview(b"\x10\x40abc"))
    sent = [SentFrame.of(number, memoryview(b"x" * number)) for number in range(3)]
    ring.writer.add_sent(4, 78, sent)
    (run,) = reader.runs()
    assert list(records_in(run.octets)) == [
        (3, False, 77, 0x2_7F000101_0000, b"\x10\x40abc"),
        *((4, True, 78, number, b"x" * number) for number in range(3)),
    ]
    assert taken(reader) == ([], 0)


def test_ports_are_numbered_once_and_kept_for_the_next_writer():
    ring = Ring()
    assert [ring.writer.number(name) for name in ("a/e", "b/e", "a/e")] == [0, 1, 0]
    assert ring.open().number("b/e") == 1
    assert ring.reader().header.ports == ["a/e", "b/e"]


def test_port_beyond_the_list_gets_no_number():
    ring = Ring()
    names = [f"{'x' * 250}/{n}" for n in range(400)]
    numbers = [ring.writer.number(name) for name in names]
    known = [number for number in numbers if number is not None]
    assert 200 < len(known) < 400
    assert ring.header.ports == names[: len(known)]


def test_reader_drops_frames_of_other_ports():
    ring = Ring()
    reader = ring.reader()
    ring.add(b"a", port=0)
    ring.add(b"b", port=1)
    ring.add(b"c", port=2)
    (run,) = reader.runs()
    assert [each.frame for each in records_in(run.octets, [True, False])] == [b"a"]


FRAMES = st.lists(st.binary(max_size=300), min_size=1, max_size=3)


@given(st.lists(st.tuples(FRAMES, st.booleans()), max_size=40))
def test_frames_are_read_in_order_or_counted_as_lost(steps):
    ring = Ring()
    reader = ring.reader()
    written, read, lost = [], [], 0
    for frames, looks in steps:
        ring.add(*frames)
        written += frames
        if looks:
            found, missed = taken(reader)
            lost += missed
            read += found
            # All that is not lost comes in order, up to the frame written last.
            assert found == written[len(written) - len(found) :]
    found, missed = taken(reader)
    assert len(read + found) + lost + missed == len(written)


def test_slow_reader_counts_what_was_overwritten():
    ring = Ring()
    slow, quick = ring.reader(), ring.reader()
    frames = [bytes([n]) * 100 for n in range(50)]
    for frame in frames:
        ring.add(frame)
        assert taken(quick) == ([frame], 0)
    rest, lost = taken(slow)
    assert 0 < len(rest) < 10
    assert (rest, lost) == (frames[-len(rest) :], 50 - len(rest))
    ring.add(b"next")
    assert taken(slow) == ([b"next"], 0)


def test_reader_overtaken_while_it_copies_takes_nothing_of_it():
    ring = Ring()
    reader = ring.reader()
    ring.add(b"x" * 100)
    ring.header.words[RingWord.RESERVED] += CAPACITY  # as a writer does that comes round again
    assert taken(reader) == ([], 0)
    ring.header.words[RingWord.RESERVED] -= CAPACITY
    assert taken(reader) == ([b"x" * 100], 0)


def test_writer_that_was_killed_in_a_record_leaves_a_whole_ring():
    ring = Ring()
    reader = ring.reader()
    ring.add(b"first")
    assert taken(reader) == ([b"first"], 0)
    ring.header.words[RingWord.RESERVED] += 64
    ring.memory[HEADER_SIZE + 32 : HEADER_SIZE + 96] = b"\x55" * 64
    ring.writer = ring.open()
    ring.add(b"second")
    assert taken(reader) == ([b"second"], 0)


def test_ring_is_wanted_for_the_term_after_the_last_reader():
    ring = Ring()
    now_ns = 5_000
    assert not ring.header.is_wanted(now_ns)
    reader = ring.reader()
    reader.header.extend(now_ns)
    assert ring.header.is_wanted(now_ns + RECORDING_TERM_NS - 1)
    assert not ring.header.is_wanted(now_ns + RECORDING_TERM_NS)
    ring.reader().header.extend(now_ns - 1000)  # another reader takes nothing away
    assert ring.header.is_wanted(now_ns + RECORDING_TERM_NS - 1)


def test_memory_of_something_else_is_no_ring():
    with pytest.raises(ImageError, match="not a ring of frames"):
        RingHeader(memoryview(bytearray(HEADER_SIZE)))
