"""A condition over variables and counters, evaluated for each cycle of a running plant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.closeable import Closeable
from eap.expressions import Condition
from eap.recording.capture import SampledVariable, StationCapture, count_of, find_name, samples_in


class ConditionWatch(Closeable):
    """Evaluates a condition; a counter in it has the number by which it grew since the last look.

    Args:
        condition: The condition.
        paths: Process images of the plant, by station.

    Raises:
        ImageError: it has a name that is unknown here, or there is no image.
    """

    def __init__(self, condition: Condition, paths: Mapping[str, Path]) -> None:
        self._condition = condition
        self._values: list[Any] = [None] * len(condition.names)
        self._captures: dict[str, StationCapture] = {}
        try:
            for station, path in paths.items():
                self._captures[station] = StationCapture(path)
            self._find_names()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the images."""
        for capture in self._captures.values():
            capture.close()

    def look(self, offset_ns: int) -> Iterator[tuple[int, bool]]:
        """Yield the condition after each cycle since the last call, with its Unix time."""
        samples = [
            (time_ns, station, sample)
            for station, capture in self._captures.items()
            for block in capture.look(offset_ns).blocks
            for _, time_ns, sample in samples_in(block)
        ]
        # Variables of several stations are compared at one time, in the order of their cycles.
        samples.sort(key=lambda each: each[0])
        values, is_true = self._values, self._condition.is_true
        for time_ns, station, sample in samples:
            for index, value in self._sampled[station]:
                values[index] = value.read(sample)
            yield time_ns, is_true(values)
        if self._counters:
            for index, station, counter in self._counters:
                now = count_of(self._captures[station].image, counter)
                grown = now - self._counts[station, counter]
                self._counts[station, counter] = now
                # Several stations may stand for one name; a restarted plant counts from 0.
                values[index] = (values[index] or 0) + max(grown, 0)
            yield monotonic_ns() + offset_ns, is_true(values)
            for index, _, _ in self._counters:
                values[index] = 0

    def follow(self, *, thoroughly: bool) -> None:
        """Follow changed stations; raises as the initializer does."""
        moved = [each.follow(thoroughly=thoroughly) for each in self._captures.values()]
        if any(moved):
            self._find_names()

    def _find_names(self) -> None:
        images = {name: capture.image for name, capture in self._captures.items()}
        self._sampled: dict[str, list[tuple[int, SampledVariable]]] = {name: [] for name in images}
        self._counters: list[tuple[int, str, str]] = []
        for index, name in enumerate(self._condition.names):
            stations, variable, is_counter = find_name(images, name)
            for station in stations:
                if is_counter:
                    self._counters.append((index, station, variable))
                else:
                    self._sampled[station].append(
                        (index, SampledVariable(images[station], variable))
                    )
        self._counts = {
            (station, counter): count_of(images[station], counter)
            for _, station, counter in self._counters
        }
        # Without a value to sample, only the counters of a station are read.
        used = {station for _, station, _ in self._counters}
        used |= {station for station, found in self._sampled.items() if found}
        for station in images.keys() - used:
            self._captures.pop(station).close()
