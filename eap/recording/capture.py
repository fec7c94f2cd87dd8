"""Capture of values and frames of a running appliance, by reading its shared memory.

A :class:`StationCapture` reads the samples of one station, a :class:`PortCapture` the ring of
frames.  Nothing here talks to a process of the plant, and the plant never waits for it.  Each look
returns what came since the one before, and what was missed: that is the recorder's loss, unlike
cycles that did not run because the engine was restarted.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import monotonic_ns, time_ns
from typing import Any, NamedTuple

from eap.closeable import Closeable
from eap.codec import datatypes
from eap.config.record_texts import COUNTERS
from eap.errors import ImageError
from eap.net.framering_file import AttachedRing
from eap.net.image_file import ImageFile, open_image
from eap.pd.framering import RingRecord, records_in
from eap.pd.image import Image, ImageSamples, extract_value
from eap.pd.layout import ImageLayout
from eap.pd.quality import tracker_word
from eap.pd.words import PD_DROP_REASONS, FrameWord, RxWord, StationWord, TxWord

_RESTART_LOOKS = 2
_HEAD = struct.Struct("<qq")
"""Cycle and Unix time in front of each sample of a block."""


class CapturedBlock(NamedTuple):
    """Samples of a station, or frames, that were captured in one look.

    *source* is the name of a station, or empty for frames; *data* are samples behind their heads
    (:func:`samples_in`), or records of the ring, whose times have *offset_ns* to Unix time.
    """

    source: str
    first_ns: int
    last_ns: int
    """Unix times of the first and the last of them."""
    data: bytes
    size: int = 0
    """Bytes of one sample."""
    offset_ns: int = 0


class Gap(NamedTuple):
    """Cycles or frames that are missing; *is_loss* if the recorder missed them."""

    source: str
    time_ns: int
    missing: int
    is_loss: bool


class Look(NamedTuple):
    """Result of one look."""

    blocks: list[CapturedBlock]
    gaps: list[Gap]


def unix_offset_ns() -> int:
    """Return how far Unix time is from the monotonic clock."""
    # Unix time is read between two readings of the other clock.  An interruption comes in between,
    # too: the readings that are closest to each other are right.
    readings = ((monotonic_ns(), time_ns(), monotonic_ns()) for _ in range(3))
    first_ns, unix_ns, last_ns = min(readings, key=lambda each: each[2] - each[0])
    return unix_ns - (first_ns + last_ns) // 2


def samples_in(block: CapturedBlock) -> Iterator[tuple[int, int, bytes]]:
    """Yield cycle, Unix time and sample of a block of values."""
    data, step = block.data, _HEAD.size + block.size
    for at in range(0, len(data), step):
        cycle, time = _HEAD.unpack_from(data, at)
        yield cycle, time, data[at + _HEAD.size : at + step]


def frames_in(block: CapturedBlock, ports: Sequence[bool]) -> Iterator[tuple[int, RingRecord]]:
    """Yield Unix time and record of those frames of a block whose *ports* are true."""
    for record in records_in(block.data, ports):
        yield record.at_ns + block.offset_ns, record


class StationCapture(Closeable):
    """Samples of one station, every *every*-th cycle.

    Args:
        path: Of its process image.
        every: Distance of the recorded cycles, counted by the cycle number.

    Attributes:
        layout: Of the present image.

    Raises:
        ImageError: there is no image.
    """

    def __init__(self, path: Path, every: int = 1) -> None:
        self._path = path
        self._every = every
        self._file = open_image(path)
        self._samples = ImageSamples(self._file.image)
        self._last = self._samples.newest + 1
        self._restarts = self._word(StationWord.RESTARTS)
        self._looks_since = _RESTART_LOOKS
        self._samples.extend()
        self._is_final = False

    def close(self) -> None:
        """Release the image."""
        self._file.close()

    @property
    def layout(self) -> ImageLayout:
        """The directory of the present image."""
        return self._file.image.layout

    @property
    def image(self) -> Image:
        """The present image."""
        return self._file.image

    @property
    def depth_ns(self) -> int:
        """Time for which samples are kept."""
        return 1000 * self._samples.count * self.layout.cycle_us

    def look(self, offset_ns: int) -> Look:
        """Return the samples since the last call; Unix time has *offset_ns* to the clock."""
        samples, last, every = self._samples, self._last, self._every
        # Read before the samples: no cycle runs in an image after it was retired.
        self._is_final = self._file.retired
        was_restarted = self._note_restart()
        parts: list[bytes] = []
        found = samples.since(last)
        expected = 0
        first_ns = last_ns = 0
        for cycle in found:
            if cycle % every:
                continue
            expected += 1
            at_ns = samples.ran_at_ns(cycle)
            data = samples.read(cycle)
            if at_ns is None or data is None:
                continue
            last_ns = at_ns + offset_ns
            first_ns = first_ns or last_ns
            parts += (_HEAD.pack(cycle, last_ns), data)
        gaps = []
        newest = found[-1] if found else last
        if found:
            missed = newest // every - last // every - len(parts) // 2
            if missed > 0:
                time_ns = first_ns or monotonic_ns() + offset_ns
                gaps.append(Gap(self.layout.station, time_ns, missed, is_loss=not was_restarted))
        self._last = newest
        self._samples.extend()
        if not parts:
            return Look([], gaps)
        source, size = self.layout.station, len(parts[1])
        return Look([CapturedBlock(source, first_ns, last_ns, b"".join(parts), size)], gaps)

    def follow(self, *, thoroughly: bool) -> bool:
        """Go to the image that has replaced the present one; return whether there is one.

        Args:
            thoroughly: Whether to look for one that an engine left that was killed meanwhile.

        Raises:
            ImageError: the new one cannot be opened yet.
        """
        if not self._is_final:
            # One that was retired after the last look has samples that were not read yet.
            file = self._file
            if not thoroughly or not file.is_replaced or file.retired:
                return False
        self._exchange(open_image(self._path))
        return True

    def _exchange(self, fresh: ImageFile) -> None:
        self._file.close()
        self._file = fresh
        self._samples = ImageSamples(fresh.image)
        self._samples.extend()
        self._is_final = False
        # A file of a plant that was started again counts from the beginning.
        self._last = min(self._last, self._samples.newest + 1)

    def _note_restart(self) -> bool:
        """Return whether the engine was started again since one of the last two looks."""
        restarts = self._word(StationWord.RESTARTS)
        # The engine writes this word before the cycle number; a look may come in between, or
        # before the first cycle that runs.
        self._looks_since = self._looks_since + 1 if restarts == self._restarts else 0
        self._restarts = restarts
        return self._looks_since < _RESTART_LOOKS

    def _word(self, word: StationWord) -> int:
        return int(self._file.image.words[word])


class PortCapture(Closeable):
    """Frames of all ports of an appliance.

    Args:
        path: Of the ring.

    Raises:
        ImageError: there is no ring.
        EnvironmentalError: there is no memory for one.
    """

    def __init__(self, path: Path) -> None:
        self._ring = AttachedRing(path)
        self._ring.reader.header.extend(monotonic_ns())

    def close(self) -> None:
        """Release the ring; the engine stops recording if nobody else reads."""
        self._ring.close()

    @property
    def ports(self) -> list[str]:
        """The ports by their numbers in the records, as ``STATION/PORT``."""
        return self._ring.reader.header.ports

    def look(self, offset_ns: int) -> Look:
        """Return the frames since the last call; Unix time has *offset_ns* to the clock."""
        reader = self._ring.reader
        reader.header.extend(monotonic_ns())
        blocks, gaps = [], []
        now_ns = monotonic_ns() + offset_ns
        for octets, lost in reader.runs():
            first_ns = next(records_in(octets)).at_ns + offset_ns
            if lost:
                gaps.append(Gap("", first_ns, lost, is_loss=True))
            blocks.append(CapturedBlock("", first_ns, now_ns, octets, offset_ns=offset_ns))
        return Look(blocks, gaps)


_TRACKED = {
    "lost": RxWord.LOST,
    "late": RxWord.LATE,
    "duplicated": RxWord.DUPLICATED,
    "reordered": RxWord.REORDERED,
    "timeouts": RxWord.TIMEOUTS,
}


def count_of(image: Image, counter: str) -> int:
    """Return a counter of a station: the sum over its PDs.

    Raises:
        ValueError: there is none of that name.
    """
    words, layout = image.words, image.layout
    if counter in _TRACKED:
        # Of a tracker once, though several PDs share it: what is lost is a frame.
        trackers = {tracker_word(image, slot) for slot in layout.rx}
        return sum(words[first + _TRACKED[counter]] for first in trackers)
    if counter == "dropped":
        size = len(PD_DROP_REASONS)
        blocks = [StationWord.DISCARDED, *(slot.words + RxWord.DISCARDED for slot in layout.rx)]
        return sum(sum(words[first : first + size].tolist()) for first in blocks)
    if counter == "skipped":
        frames = sum(words[slot.words + FrameWord.SKIPPED] for slot in layout.frames)
        return int(frames + sum(words[slot.words + TxWord.SKIPPED] for slot in layout.tx))
    if counter == "overruns":
        return int(words[StationWord.OVERRUNS])
    raise ValueError(f"{counter} is no counter; counters are {', '.join(COUNTERS)}")


class SampledVariable:
    """A variable, or a part of one, in the samples of a station.

    Raises:
        ImageError: the station has no such variable.
    """

    def __init__(self, image: Image, name: str) -> None:
        slot = image.slot(name)
        self._slot = slot
        self._kind = datatypes.parse(slot.type)
        self._first_bit = 8 * image.layout.samples.first

    def read(self, sample: bytes) -> Any:
        """Return the value in *sample*."""
        return self._kind.decode(extract_value(self._slot, sample, self._first_bit), 0)


def find_name(images: Mapping[str, Image], name: str) -> tuple[list[str], str, bool]:
    """Return what *name* of a condition is: stations, variable or counter, and whether a counter.

    Raises:
        ImageError: it is neither; the message names what is known.
    """
    station, _, rest = name.partition("/")
    if not rest:
        if name in COUNTERS:
            return list(images), name, True
        known = f"a counter ({', '.join(COUNTERS)}) or STATION/VARIABLE"
        raise ImageError(f"condition: {name!r} is no counter; expected {known}")
    if station not in images:
        raise ImageError(
            f"condition: unknown station {station!r}; known stations: {', '.join(images)}"
        )
    try:
        SampledVariable(images[station], rest)
    except ImageError as exc:
        if rest in COUNTERS:
            return [station], rest, True
        raise ImageError(f"condition: {exc}") from None
    return [station], rest, False
