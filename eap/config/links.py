"""Links of a plant file between variables: the bits that they copy, their order, and checks.

A link whose source is the target of another link runs after it, so that a value passes a chain of
links in one cycle.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from eap.codec.datatypes import Boolean, DataType
from eap.config.finding import FindingReport
from eap.config.index import Index, Span, VariablePart
from eap.config.structs import LinkSection, StationSection
from eap.config.variables import named_part
from eap.pd.spec import CsvSource, HostSource


class Ends(NamedTuple):
    """Source and target of a link, in bits."""

    source: Span
    target: Span


def is_bitwise(link: LinkSection) -> bool:
    """Return whether *link* selects the bits that it copies."""
    return any(each is not None for each in (link.from_bit, link.to_bit, link.bits))


def is_scaled(link: LinkSection) -> bool:
    """Return whether *link* computes its value."""
    return link.scale is not None or link.offset is not None


def ends(link: LinkSection, source: VariablePart, target: VariablePart) -> Ends:
    """Return the bits at both ends of *link*; without ``bits`` as many as both ends have."""
    if not is_bitwise(link):
        return Ends(source.span, target.span)
    from_bit, to_bit = link.from_bit or 0, link.to_bit or 0
    bits = link.bits or min(source.kind.bit_length - from_bit, target.kind.bit_length - to_bit)
    return Ends(
        Span(source.variable, source.bit_offset + from_bit, bits),
        Span(target.variable, target.bit_offset + to_bit, bits),
    )


def execution_order(links: Sequence[Ends]) -> list[int]:
    """Return the positions of *links* in execution order, without those in and behind a loop.

    Links that do not depend on each other keep their order.
    """
    before = _predecessors(links)
    after = defaultdict(list)
    for position, others in enumerate(before):
        for other in others:
            after[other].append(position)
    missing = [len(others) for others in before]
    free = [position for position, number in enumerate(missing) if not number]
    # A heap, not a queue: links that are free to run keep the order of the file.
    heapify(free)
    order = []
    while free:
        order.append(heappop(free))
        for position in after[order[-1]]:
            missing[position] -= 1
            if not missing[position]:
                heappush(free, position)
    return order


def find_loops(links: Sequence[Ends]) -> list[list[int]]:
    """Return loops of *links* that have no link in common, each in the direction of its values."""
    before = _predecessors(links)
    left = set(range(len(links))) - set(execution_order(links))
    loops = []
    while left:
        loop = _walk_back(before, left)
        if loop:
            # From its first link in the file, so that the same loop has the same text each time.
            first = loop.index(min(loop))
            loops.append(loop[first:] + loop[:first])
    return loops


def _walk_back(before: Sequence[Sequence[int]], left: set[int]) -> list[int]:
    """Walk back to the first repeated link; remove the loop, or a link without one, from *left*."""
    path = [min(left)]
    while True:
        earlier = next((each for each in before[path[-1]] if each in left), None)
        if earlier is None:
            left.discard(path[-1])
            return []
        if earlier in path:
            loop = path[path.index(earlier) :][::-1]
            left.difference_update(loop)
            return loop
        path.append(earlier)


def _predecessors(links: Sequence[Ends]) -> list[list[int]]:
    writers = defaultdict(list)
    for position, link in enumerate(links):
        writers[link.target.variable].append(position)
    return [
        [
            position
            for position in writers[link.source.variable]
            # By bits: a link may fill one bit of a variable and another one read the next.
            if links[position].target.overlaps(link.source)
        ]
        for link in links
    ]


_TARGET = "a variable of the station's own, or an output of a bus"

_KEYS = ("from_bit", "to_bit", "bits", "scale", "offset", "swap")


def check_links(index: Index, report: FindingReport) -> None:
    """Report every link that cannot run, or that shares its target with another writer."""
    for station in index.plant.stations:
        known: list[tuple[LinkSection, Ends]] = []
        for link in station.links:
            source = named_part(index, report, station, f"{link.at}.from", link.source)
            target = named_part(index, report, station, f"{link.at}.to", link.target)
            if target is not None:
                _check_writer(index, report, station, link, target)
            if source is None or target is None:
                continue
            if not _fits(link, source.kind, target.kind, report):
                continue
            known.append((link, ends(link, source, target)))
        _check_duplicates(known, report)
        _check_loops(known, report)


def _check_writer(
    index: Index,
    report: FindingReport,
    station: StationSection,
    link: LinkSection,
    target: VariablePart,
) -> None:
    name = target.variable
    on_bus = index.bus_variables(station).get(name)
    if name in station.variables:
        source = _source_beside(index, station, link, target)
        if not source:
            return
        line = report.line_of(f"{station.at}.sources.{source}")
        reason = f"has a source (line {line})"
    elif on_bus is None:
        reason = "is received"
    elif on_bus.is_output:
        return
    else:
        reason = "comes from a bus"
    report.add(f"{link.at}.to", f"{link.target!r} {reason}, so no link can write it", _TARGET)


def _source_beside(
    index: Index, station: StationSection, link: LinkSection, target: VariablePart
) -> str:
    """Return a source that fills what *link* writes, or its variable from another process."""
    for name, source in station.sources.items():
        try:
            part = index.part(station, name)
        except ValueError:
            continue
        if part is None or part.variable != target.variable:
            continue
        span = part.span
        both = ends(link, target, target)
        if isinstance(source, HostSource | CsvSource) or span.overlaps(both.target):
            return name
    return ""


def _fits(link: LinkSection, source: DataType, target: DataType, report: FindingReport) -> bool:
    """Return whether a link can connect these types, after reporting the reason if not."""
    if any(report.has(f"{link.at}.{key}") for key in _KEYS):
        return False
    if is_bitwise(link):
        return _fits_bitwise(link, source, target, report)
    shown = f"{link.source} is {source.name}, {link.target} is {target.name}"
    if is_scaled(link):
        return _fits_scaled(link, source, target, shown, report)
    return _fits_whole(link, source, target, shown, report)


def _fits_whole(
    link: LinkSection, source: DataType, target: DataType, shown: str, report: FindingReport
) -> bool:
    if link.swap:
        if _can_swap(source, target):
            return True
        report.add(f"{link.at}.swap", shown, "two variables of the same size, at least 2 bytes")
        return False
    if source.wire != target.wire and not (_is_bool(source) and _is_bool(target)):
        ways = [f"bits: {min(source.bit_length, target.bit_length)}"]
        if _is_number(source) and _is_number(target):
            ways.append("scale")
        if _can_swap(source, target):
            ways.append("swap")
        *first, last = ways
        others = f"{', '.join(first)} or {last}" if first else last
        report.add(link.at, shown, f"both alike, or {others}")
        return False
    return True


def _can_swap(source: DataType, target: DataType) -> bool:
    return source.size == target.size > 1 and not (source.is_bits or target.is_bits)


def _fits_bitwise(
    link: LinkSection, source: DataType, target: DataType, report: FindingReport
) -> bool:
    for key in ("scale", "offset", "swap"):
        if getattr(link, key):
            report.add(
                f"{link.at}.{key}", f"the link copies bits and has a {key}", "one of the two"
            )
            return False
    for key, bit, name, kind in (
        ("from_bit", link.from_bit or 0, link.source, source),
        ("to_bit", link.to_bit or 0, link.target, target),
    ):
        if bit >= kind.bit_length:
            message = f"{name} is {kind.name} and has no bit {bit}"
            report.add(f"{link.at}.{key}", message, f"0 to {kind.bit_length - 1}")
            return False
        if link.bits is not None and bit + link.bits > kind.bit_length:
            message = f"{name} is {kind.name} and has no {link.bits} bits from bit {bit} on"
            report.add(f"{link.at}.bits", message, f"at most {kind.bit_length - bit}")
            return False
    return True


def _fits_scaled(
    link: LinkSection, source: DataType, target: DataType, shown: str, report: FindingReport
) -> bool:
    key = "scale" if link.scale is not None else "offset"
    # It would make a constant, which a default does better.
    if link.scale == 0:
        report.add(f"{link.at}.scale", "scale is 0", "another number")
        return False
    if not (_is_number(source) and _is_number(target)):
        report.add(f"{link.at}.{key}", shown, f"numbers such as INT or REAL where there is a {key}")
        return False
    if link.swap and source.size < 2:
        report.add(f"{link.at}.swap", shown, "a source of at least 2 bytes")
        return False
    is_plain = link.scale in {None, 1} and not link.offset
    if link.swap and is_plain and source != target and source.size == target.size:
        # The engine does not distinguish it from a swap alone, which converts nothing.
        message = f"{shown}: a swap with {key} {getattr(link, key):g} computes nothing"
        report.add(f"{link.at}.{key}", message, "swap alone to copy the bytes, or another number")
        return False
    return True


def _is_number(kind: DataType) -> bool:
    # BOOL has a range from 0 to 1, but a scaled BOOL is an error of the file.
    return kind.scalar_range is not None and not _is_bool(kind)


def _is_bool(kind: DataType) -> bool:
    """Return whether *kind* is a BOOL; that of a struct has a byte, another one a bit."""
    return isinstance(kind, Boolean)


def _check_duplicates(links: list[tuple[LinkSection, Ends]], report: FindingReport) -> None:
    first: dict[str, list[tuple[LinkSection, Ends]]] = {}
    for link, both in links:
        others = first.setdefault(both.target.variable, [])
        twice = next((other for other, span in others if span.target.overlaps(both.target)), None)
        others.append((link, both))
        if twice is not None:
            line = report.line_of(f"{twice.at}.to")
            message = f"{link.target!r} is linked twice (first in line {line})"
            report.add(
                f"{link.at}.to", message, "one link for each variable, or for each bit of it"
            )


def _check_loops(links: list[tuple[LinkSection, Ends]], report: FindingReport) -> None:
    for loop in find_loops([both for _, both in links]):
        members = [links[position][0] for position in loop]
        path = " → ".join([members[0].source, *(link.target for link in members)])
        report.add(members[0].at, f"links form a loop: {path}", "one of them to be left out")
