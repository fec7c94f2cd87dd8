"""Comparison of a bus with the expected one, and the places of expected slaves on it.

Slaves stand in the configured order, with exceptions: one that an alias, an identification or a
serial number tells from the others may be anywhere with those behind it, and an optional one may be
absent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from difflib import SequenceMatcher
from itertools import combinations, groupby
from typing import TypeAlias

import msgspec

from devicebus.errors import IdentityError
from devicebus.master.pdo import ProcessDataChannel
from devicebus.master.scan import FoundSlave, Identity
from eap.od.slave_config import ALIAS_REGISTER, BY_SERIAL, SlaveConfig

_EXCHANGE = ": exchange the cables or the names in the bus file"


class ExpectedSlave(msgspec.Struct, frozen=True, kw_only=True):
    """Configured slave; None accepts any value."""

    name: str
    vendor: int
    product: int
    revision: int | None = None
    serial: int | None = None
    alias: int | None = None
    """Alias; a slave with one other than 0 may have any position (:func:`match_slaves`)."""
    config: SlaveConfig = SlaveConfig()
    channels: tuple[ProcessDataChannel, ...] = ()
    """Process data that is planned for it while it is absent; empty takes that of its EEPROM."""

    @property
    def is_optional(self) -> bool:
        """True if it may be absent, as all slaves of a hot-connect group."""
        return self.config.optional or bool(self.config.group)

    @property
    def mark(self) -> tuple[int, int] | None:
        """Register and value that tell it from equal slaves; None without one."""
        register = self.config.identification
        value = self.serial if register == BY_SERIAL else self.alias
        return (register, value) if value else None


Marks: TypeAlias = Mapping[int, int]
"""Values of a found slave by register: alias, identification, serial number."""


def marks_of(slave: FoundSlave) -> dict[int, int]:
    """Return the values that a scan has read."""
    return {ALIAS_REGISTER: slave.alias, BY_SERIAL: slave.identity.serial}


def fits(expected: ExpectedSlave, identity: Identity) -> bool:
    """Return true if *identity* fits the expected slave."""
    return (
        (expected.vendor, expected.product) == (identity.vendor, identity.product)
        and (
            expected.revision is None
            or expected.config.revision_rule.accepts(expected.revision, identity.revision)
        )
        and expected.serial in {None, identity.serial}
    )


def match_slaves(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks]
) -> tuple[int, ...]:
    """Return the number of the expected slave for each position.

    Args:
        expected: Expected slaves in the order of the configuration.
        found: Slaves in the order of the segment.
        marks: Values of each of them.

    Raises:
        IdentityError: the bus is not as expected; the message has every difference.
    """
    groups = list(_movable_groups(expected))
    placed = _place_groups(expected, groups, found, marks)
    movable = {number for group in groups for number in group}
    rest = [number for number in range(len(expected)) if number not in movable]
    positions = [position for position in range(len(found)) if position not in placed]
    there = [found[position] for position in positions]
    theirs = [marks[position] for position in positions]
    rest = [rest[at] for at in order_by_marks([expected[number] for number in rest], theirs)]
    kept = _without_absent([expected[number] for number in rest], there, theirs)
    rest = [rest[at] for at in kept]
    check_bus([expected[number] for number in rest], there, theirs)
    placed.update(zip(positions, rest, strict=True))
    return tuple(placed[position] for position in range(len(found)))


def check_bus(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks] = ()
) -> None:
    """Compare found with expected slaves; raise IdentityError with every difference."""
    lines = list(iter_differences(expected, found, marks))
    if lines:
        if not all(line.endswith(_EXCHANGE) for line in lines):
            lines.append("connect the slaves as expected, or name those that are there")
        text = "\n  ".join(lines)
        raise IdentityError(
            f"the bus is not as configured ({len(expected)} slaves expected, {len(found)} found):"
            f"\n  {text}"
        )


def order_by_marks(expected: Sequence[ExpectedSlave], marks: Sequence[Marks]) -> tuple[int, ...]:
    """Return the numbers of the expected slaves in the order of the found marks.

    A slave with a mark may have any position; the slaves behind it, up to the next one with a
    mark, stay behind it.  If a mark is missing or found twice, the order is the expected one; the
    mark of an optional slave may be missing.

    Args:
        expected: Expected slaves in the order of the configuration.
        marks: Values of the found slaves in the order of the segment.
    """
    there = Counter((at, value) for each in marks for at, value in each.items() if value)
    blocks: dict[tuple[int, int] | None, list[int]] = {None: []}
    usual = tuple(range(len(expected)))
    for number, each in enumerate(expected):
        mark = each.mark
        if mark is not None and mark in blocks:
            return usual
        # Behind an optional slave that is absent stands what stands behind those before it.
        if mark is not None and (there[mark] or not each.is_optional):
            blocks[mark] = []
        blocks[next(reversed(blocks))].append(number)
    order = [mark for each in marks for mark in each.items() if mark in blocks and mark is not None]
    if Counter(order) != Counter(mark for mark in blocks if mark is not None):
        return usual
    return tuple(number for mark in (None, *order) for number in blocks[mark])


def iter_differences(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks] = ()
) -> Iterator[str]:
    """Yield one line for each difference; a missing slave does not make those behind it differ.

    With the expected number of slaves, they are compared by position, and two that have each
    other's position are one difference.
    """
    marks = marks or [marks_of(slave) for slave in found]
    if len(expected) == len(found):
        swapped = _swapped(expected, found, marks)
        for at, (each, slave, its) in enumerate(zip(expected, found, marks, strict=True)):
            if at not in swapped:
                yield from _compare(each, slave, its)
            elif at < swapped[at]:
                names = f"{each.name} and {expected[swapped[at]].name}"
                yield f"{names} are swapped{_EXCHANGE}"
        return
    matcher = SequenceMatcher(
        None,
        [(each.vendor, each.product) for each in expected],
        [(each.identity.vendor, each.identity.product) for each in found],
        # A bus has many equal slaves, which autojunk would ignore as noise.
        autojunk=False,
    )
    for _, start, end, there, there_end in matcher.get_opcodes():
        pairs = min(end - start, there_end - there)
        for offset in range(pairs):
            at = there + offset
            yield from _compare(expected[start + offset], found[at], marks[at])
        for missing in expected[start + pairs : end]:
            before = f"after {found[there - 1 + pairs].name}" if there + pairs else "at the start"
            yield f"{missing.name} is missing {before}, expected {describe(missing)}"
        for slave in found[there + pairs : there_end]:
            yield f"{_name_of(slave)}: {slave.fault or slave.identity}, expected no slave here"


def _swapped(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks]
) -> dict[int, int]:
    """Return the positions of slaves that have each other's position, both ways."""
    wrong = [
        at for at, row in enumerate(zip(expected, found, marks, strict=True)) if not _is_match(*row)
    ]
    swapped: dict[int, int] = {}
    for first, second in combinations(wrong, 2):
        if (
            not {first, second} & swapped.keys()
            and _is_match(expected[first], found[second], marks[second])
            and _is_match(expected[second], found[first], marks[first])
        ):
            swapped |= {first: second, second: first}
    return swapped


def has_mark(expected: ExpectedSlave, marks: Marks) -> bool:
    """Return true if the expected alias or identification is there, or none is expected."""
    return expected.alias in {None, marks.get(_alias_register(expected), 0)}


def describe(expected: ExpectedSlave) -> str:
    """Return the accepted identity in words."""
    text = f"vendor 0x{expected.vendor:08X}, product 0x{expected.product:08X}"
    if expected.revision is not None:
        text += f", {expected.config.revision_rule.describe(expected.revision)}"
    if expected.serial is not None:
        text += f", serial {expected.serial}"
    return text


def _movable_groups(expected: Sequence[ExpectedSlave]) -> Iterator[list[int]]:
    """Yield the numbers of each hot-connect group whose first slave has a mark."""
    for name, members in groupby(enumerate(expected), key=lambda each: each[1].config.group):
        numbers = [number for number, _ in members]
        if name and expected[numbers[0]].mark is not None:
            yield numbers


def _place_groups(
    expected: Sequence[ExpectedSlave],
    groups: Sequence[Sequence[int]],
    found: Sequence[FoundSlave],
    marks: Sequence[Marks],
) -> dict[int, int]:
    """Return position and number of the slaves of *groups*, wherever they are on the bus."""
    heads = {expected[group[0]].mark: group for group in groups}
    placed: dict[int, int] = {}
    for position, its in enumerate(marks):
        mark = next((each for each in its.items() if each in heads), None)
        if mark is None or position in placed:
            continue
        at = position
        for number in heads.pop(mark):
            if at < len(found) and _is_match(expected[number], found[at], marks[at]):
                placed[at] = number
                at += 1
    return placed


def _without_absent(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks]
) -> list[int]:
    """Return the numbers of the expected slaves without optional ones that are absent.

    Those are left out with which the bus differs least from the expected one; of equal slaves the
    first are taken to be present.
    """
    optional = [number for number, each in enumerate(expected) if each.is_optional]
    everyone = list(range(len(expected)))
    if not optional or (
        len(expected) == len(found)
        and all(_is_match(*each) for each in zip(expected, found, marks, strict=True))
    ):
        return everyone
    left_out = _absent_exactly(expected, found, marks)
    if left_out is None:
        left_out = _absent_nearly(expected, found, marks)
    return [number for number in everyone if number not in left_out]


def _absent_exactly(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks]
) -> set[int] | None:
    """Return the optional slaves without which the bus is exactly as expected; None if it is not.

    The work grows with the number of slaves times that of the absent ones.
    """
    rows, columns = len(expected), len(found)
    absent = rows - columns
    # fitting: all (i, j) for which found[j:] is expected[i:] without optional slaves.
    fitting = {(rows, columns)}
    for i in reversed(range(rows)):
        for j in range(max(0, i - absent), min(i, columns) + 1):
            is_absent = expected[i].is_optional and (i + 1, j) in fitting
            if is_absent or (
                (i + 1, j + 1) in fitting and _is_match(expected[i], found[j], marks[j])
            ):
                fitting.add((i, j))
    if (0, 0) not in fitting:
        return None
    left_out = set()
    j = 0
    for i in range(rows):
        if (i + 1, j + 1) in fitting and _is_match(expected[i], found[j], marks[j]):
            j += 1
        else:
            left_out.add(i)
    return left_out


_OTHER_REVISION, _OTHER_SLAVE = 1, 2


def _absent_nearly(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave], marks: Sequence[Marks]
) -> set[int]:
    """Return the optional slaves that an alignment with the fewest differences leaves out.

    For the message about a bus that is not as expected: the work grows with the square of its size.
    """
    rows, columns = len(expected), len(found)
    # costs[i][j]: differences between expected[i:] and found[j:].
    costs = [[0] * (columns + 1) for _ in range(rows + 1)]
    pairs = [[0] * columns for _ in range(rows)]
    costs[rows] = [_OTHER_SLAVE * (columns - j) for j in range(columns + 1)]
    skips = [0 if each.is_optional else _OTHER_SLAVE for each in expected]
    for i in reversed(range(rows)):
        costs[i][columns] = costs[i + 1][columns] + skips[i]
        for j in reversed(range(columns)):
            pairs[i][j] = _pair_cost(expected[i], found[j], marks[j])
            costs[i][j] = min(
                pairs[i][j] + costs[i + 1][j + 1],
                skips[i] + costs[i + 1][j],
                _OTHER_SLAVE + costs[i][j + 1],
            )
    left_out = set()
    i = j = 0
    while i < rows:
        if j < columns and costs[i][j] == pairs[i][j] + costs[i + 1][j + 1]:
            i, j = i + 1, j + 1
        elif costs[i][j] == skips[i] + costs[i + 1][j]:
            if expected[i].is_optional:
                left_out.add(i)
            i += 1
        else:
            j += 1
    return left_out


def _pair_cost(expected: ExpectedSlave, slave: FoundSlave, marks: Marks) -> int:
    if _is_match(expected, slave, marks):
        return 0
    there = slave.identity
    is_alike = (expected.vendor, expected.product) == (there.vendor, there.product)
    return _OTHER_REVISION if is_alike else _OTHER_SLAVE


def _is_match(expected: ExpectedSlave, slave: FoundSlave, marks: Marks) -> bool:
    return not slave.fault and fits(expected, slave.identity) and has_mark(expected, marks)


def _compare(expected: ExpectedSlave, slave: FoundSlave, marks: Marks) -> Iterator[str]:
    if slave.fault:
        yield f"{_name_of(slave)}: {slave.fault}, expected {expected.name}"
    elif not fits(expected, slave.identity):
        serial = f", serial {slave.identity.serial}" if expected.serial is not None else ""
        yield (
            f"{_name_of(slave)}: {slave.identity}{serial},"
            f" expected {expected.name} with {describe(expected)}"
        )
    elif not has_mark(expected, marks):
        register = _alias_register(expected)
        what = "alias" if register == ALIAS_REGISTER else "identification"
        yield (
            f"{_name_of(slave)}: {what} {marks.get(register, 0)}, expected {expected.name} with"
            f" {what} {expected.alias}"
        )


def _alias_register(expected: ExpectedSlave) -> int:
    """Return the register with the alias or identification."""
    return expected.config.identification or ALIAS_REGISTER


def _name_of(slave: FoundSlave) -> str:
    return f"slave {slave.station} ({slave.sii.name})" if slave.sii.name else slave.name
