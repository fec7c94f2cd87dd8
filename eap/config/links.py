"""What links copy, bit by bit, and the order in which they run.

A link whose source is the target of another one runs after it, so that a value goes through a chain
of links in one cycle.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from eap.codec.values import DataType
from eap.config.structs import Link


class Span(NamedTuple):
    """Consecutive bits of one variable."""

    variable: str
    start: int
    bits: int

    def overlaps(self, other: Span) -> bool:
        """Tell whether both have a bit in common."""
        return (
            self.variable == other.variable
            and self.start < other.start + other.bits
            and other.start < self.start + self.bits
        )


class Ends(NamedTuple):
    """What a link reads and what it writes."""

    source: Span
    target: Span


def is_bitwise(link: Link) -> bool:
    """Tell whether *link* says which bits it copies."""
    return any(each is not None for each in (link.from_bit, link.to_bit, link.bits))


def is_scaled(link: Link) -> bool:
    """Tell whether *link* computes its value."""
    return link.scale is not None or link.offset is not None


def ends(link: Link, source: DataType, target: DataType) -> Ends:
    """Return the bits at both ends of *link*; without ``bits`` as many as both have."""
    if not is_bitwise(link):
        return Ends(
            Span(link.source, 0, source.bit_length), Span(link.target, 0, target.bit_length)
        )
    from_bit, to_bit = link.from_bit or 0, link.to_bit or 0
    bits = link.bits or min(source.bit_length - from_bit, target.bit_length - to_bit)
    return Ends(Span(link.source, from_bit, bits), Span(link.target, to_bit, bits))


def in_order(links: Sequence[Ends]) -> list[int]:
    """Return the positions of *links* as they are to run; those in and behind a circle are missing.

    Links that do not depend on each other keep their order.
    """
    before = _predecessors(links)
    after = defaultdict(list)
    for position, others in enumerate(before):
        for other in others:
            after[other].append(position)
    missing = [len(others) for others in before]
    free = [position for position, number in enumerate(missing) if not number]
    heapify(free)
    order = []
    while free:
        order.append(heappop(free))
        for position in after[order[-1]]:
            missing[position] -= 1
            if not missing[position]:
                heappush(free, position)
    return order


def find_circles(links: Sequence[Ends]) -> list[list[int]]:
    """Return circles of *links* that have no link in common, each in the way its values go."""
    before = _predecessors(links)
    left = set(range(len(links))) - set(in_order(links))
    circles = []
    while left:
        circle = _walk_back(before, left)
        if circle:
            first = circle.index(min(circle))
            circles.append(circle[first:] + circle[:first])
    return circles


def _walk_back(before: Sequence[Sequence[int]], left: set[int]) -> list[int]:
    """Go back from a link until it repeats; take the circle, or what leads to none, off *left*."""
    way = [min(left)]
    while True:
        earlier = next((each for each in before[way[-1]] if each in left), None)
        if earlier is None:
            left.discard(way[-1])
            return []
        if earlier in way:
            circle = way[way.index(earlier) :][::-1]
            left.difference_update(circle)
            return circle
        way.append(earlier)


def _predecessors(links: Sequence[Ends]) -> list[list[int]]:
    writers = defaultdict(list)
    for position, link in enumerate(links):
        writers[link.target.variable].append(position)
    return [
        [
            position
            for position in writers[link.source.variable]
            if links[position].target.overlaps(link.source)
        ]
        for link in links
    ]
