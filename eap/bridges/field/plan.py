"""Plan of the reads of one controller: few spans for many values, and retreat where one fails."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from eap.codec.fieldaddresses import FieldPoint, unit_bits
from eap.codec.fieldtypes import get_bits


class PointKey(NamedTuple):
    """A variable that has its value from a controller, or is written there."""

    station: str
    variable: str


class ReadSpan(NamedTuple):
    """Bits of one area that are read at once, with the values in them.

    *start* and *bits* are whole bytes, registers or coils, or a single bit of S7.
    """

    area: str
    start: int
    bits: int
    keys: tuple[PointKey, ...]


class SpanLimits(NamedTuple):
    """Limits of a protocol.

    Attributes:
        most_bits: Largest span of an area.
        gap_bits: Largest gap between two values that are read together.
    """

    most_bits: Callable[[str], int]
    gap_bits: Callable[[str], int]


class ReadPlan:
    """Spans that cover all points of a controller.

    Values of one span belong to one moment.  When a span with several values is refused, each of
    them is read alone from then on: a value outside the block does not hide its neighbours.

    Args:
        points: Values by their variables.
        limits: Of the protocol.

    Attributes:
        points: The same.
        spans: The present spans, in the order of their addresses.
    """

    def __init__(self, points: Mapping[PointKey, FieldPoint], limits: SpanLimits) -> None:
        self.points = points
        self._limits = limits
        self._alone: set[PointKey] = set()
        self.spans = self._make()

    def split(self, span: ReadSpan) -> bool:
        """Read the values of *span* alone from now on; return False if there is only one."""
        if len(span.keys) < 2:
            return False
        self._alone.update(span.keys)
        self.spans = self._make()
        return True

    def _make(self) -> tuple[ReadSpan, ...]:
        found: list[ReadSpan] = []
        for key, point in sorted(self.points.items(), key=lambda each: each[1].place):
            span = _span(key, point)
            last = found[-1] if found else None
            if last is not None and key not in self._alone and self._joins(last, span):
                end = max(last.start + last.bits, span.start + span.bits)
                keys = (*last.keys, key)
                found[-1] = ReadSpan(last.area, last.start, end - last.start, keys)
            else:
                found.append(span)
        return tuple(found)

    def _joins(self, last: ReadSpan, span: ReadSpan) -> bool:
        # What failed together stays alone, otherwise it would fail again in the next round.
        if last.area != span.area or not self._alone.isdisjoint(last.keys):
            return False
        end = max(last.start + last.bits, span.start + span.bits)
        # A few bytes too many cost less than a further request.
        gap = span.start - last.start - last.bits
        return gap <= self._limits.gap_bits(
            span.area
        ) and end - last.start <= self._limits.most_bits(span.area)


def _span(key: PointKey, point: FieldPoint) -> ReadSpan:
    """Return the whole bytes, registers or coils that a value lies in."""
    unit = unit_bits(point.place.area)
    first = point.place.bit // unit
    last = -(-point.end // unit)
    return ReadSpan(point.place.area, unit * first, unit * (last - first), (key,))


def bytes_in(span: ReadSpan, data: bytes, point: FieldPoint) -> bytes:
    """Return the bytes of the value *point* out of those of its span."""
    return get_bits(data, point.place.bit - span.start, point.type.bits)


def pieces(span: ReadSpan, most_bits: int) -> list[ReadSpan]:
    """Divide a span that is longer than a request can be; its bytes are of several moments."""
    starts = range(span.start, span.start + span.bits, most_bits)
    end = span.start + span.bits
    return [span._replace(start=at, bits=min(most_bits, end - at)) for at in starts]


def batches(
    spans: Iterable[ReadSpan], fits: Callable[[Sequence[ReadSpan]], bool]
) -> list[list[ReadSpan]]:
    """Divide *spans* into requests, each as long as *fits* allows; one span always fits."""
    found: list[list[ReadSpan]] = []
    for span in spans:
        if found and fits([*found[-1], span]):
            found[-1].append(span)
        else:
            found.append([span])
    return found
