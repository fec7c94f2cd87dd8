"""Samples: values of all variables of a station at the end of each of its latest cycles.

The engine takes them as long as a reader says that they are wanted, and never waits: who looks
too late finds that the place of a sample holds a later one.  A sample is taken with the copies that
the cycle itself has read, so that its values belong to one moment, for all writers.
"""

from __future__ import annotations

from collections.abc import Iterable

from eap.pd.image import Image
from eap.pd.layout import SAMPLE_HEAD
from eap.pd.spec import Writer
from eap.pd.words import StationWord

_CYCLE = int(StationWord.CYCLE)
_SAMPLED_UNTIL = int(StationWord.SAMPLED_UNTIL)
_NO_CYCLE = 0
"""In the head of a sample that is being taken: the first cycle of a station is 1."""


class Sampler:
    """The engine's side.

    Args:
        image: Where the variables and the samples are.
        inputs: The cycle's copy of what others write, at the same offsets.
    """

    def __init__(self, image: Image, inputs: memoryview) -> None:
        self._words = image.words
        self._memory = image.memory
        self._inputs = inputs
        self._slot = slot = image.layout.samples
        self._heads = _heads(image)
        engine = image.layout.regions[Writer.ENGINE]
        self._engine = slice(engine.offset, engine.offset + engine.size)
        self._others = slice(engine.offset + engine.size, slot.last)

    def end_cycle(self, cycle: int, now_ns: int) -> None:
        """Keep the variables as they are after *cycle*, which ran at *now_ns*, if wanted."""
        if cycle <= self._words[_SAMPLED_UNTIL]:
            self._take(cycle, now_ns)

    def _take(self, cycle: int, now_ns: int) -> None:
        slot, memory = self._slot, self._memory
        number = cycle % slot.count
        head = number * (slot.size // 8)
        self._heads[head] = _NO_CYCLE
        self._heads[head + 1] = now_ns
        start = slot.offset + number * slot.size + SAMPLE_HEAD
        middle = start + self._engine.stop - self._engine.start
        memory[start:middle] = memory[self._engine]
        memory[middle : start - SAMPLE_HEAD + slot.size] = self._inputs[self._others]
        self._heads[head] = cycle


class ImageSamples:
    """The side of those who read them; one in all may say what is wanted.

    Args:
        image: Where they are.

    Attributes:
        image: The same.
    """

    def __init__(self, image: Image) -> None:
        self.image = image
        self._slot = image.layout.samples
        self._heads = _heads(image)

    @property
    def newest(self) -> int:
        """The cycle that ran last, or runs right now."""
        return int(self.image.words[_CYCLE])

    def want(self, cycles: int) -> None:
        """Have samples taken of so many cycles from now on."""
        self.image.words[_SAMPLED_UNTIL] = self.newest + cycles

    def since(self, cycle: int) -> Iterable[int]:
        """Return the cycles behind *cycle* that there may be samples of, the oldest first."""
        newest = self.newest
        if self._heads[self._head(newest)] != newest:
            newest -= 1  # it runs right now
        return range(max(cycle, newest - self._slot.count) + 1, newest + 1)

    def ran_at_ns(self, cycle: int) -> int | None:
        """Return when *cycle* ran, on the monotonic clock; None if there is no sample of it."""
        head = self._head(cycle)
        at_ns = self._heads[head + 1]
        return at_ns if self._heads[head] == cycle else None

    def read(self, cycle: int) -> bytes | None:
        """Return the variables at the end of *cycle*; None if there is no sample of it."""
        start = self._slot.offset + cycle % self._slot.count * self._slot.size + SAMPLE_HEAD
        data = bytes(self.image.memory[start : start - SAMPLE_HEAD + self._slot.size])
        return data if self._heads[self._head(cycle)] == cycle else None

    def _head(self, cycle: int) -> int:
        return cycle % self._slot.count * (self._slot.size // 8)


def _heads(image: Image) -> memoryview:
    """Return the samples as words, which are stored and loaded whole."""
    slot = image.layout.samples
    return image.memory[slot.offset : slot.offset + slot.count * slot.size].cast("q")
