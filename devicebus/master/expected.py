"""The bus that is expected, and what is different on the one that is there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher

import msgspec

from devicebus.errors import IdentityError
from devicebus.master.scan import FoundSlave, Identity


class ExpectedSlave(msgspec.Struct, frozen=True, kw_only=True):
    """A slave that a configuration names; what is None may be anything."""

    name: str
    vendor: int
    product: int
    revision: int | None = None
    serial: int | None = None
    alias: int | None = None
    """With one, other than 0, it may be anywhere in the line (:func:`arrange`)."""


def fits(expected: ExpectedSlave, identity: Identity) -> bool:
    """Whether a slave may stand for the expected one."""
    return (
        (expected.vendor, expected.product) == (identity.vendor, identity.product)
        and expected.revision in {None, identity.revision}
        and expected.serial in {None, identity.serial}
    )


def check_bus(expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave]) -> None:
    """Compare the bus with what was found; raise IdentityError that lists every difference."""
    lines = list(iter_differences(expected, found))
    if lines:
        text = "\n  ".join(lines)
        raise IdentityError(
            f"the bus is not as configured ({len(expected)} slaves expected, {len(found)} found):"
            f"\n  {text}"
        )


def arrange(expected: Sequence[ExpectedSlave], aliases: Sequence[int]) -> tuple[int, ...]:
    """Return which of the expected slaves is to stand at each position, by their numbers.

    A slave that is expected with an alias is looked for wherever in the line it is, and those
    behind it up to the next with an alias stay behind it.  If an alias is missing or there twice,
    the order is the expected one.

    Args:
        expected: In the order of the configuration.
        aliases: Of the slaves that are there, in the order of the line.
    """
    blocks: dict[int, list[int]] = {0: []}
    for number, each in enumerate(expected):
        if each.alias and each.alias in blocks:
            return tuple(range(len(expected)))
        if each.alias:
            blocks[each.alias] = []
        blocks[next(reversed(blocks))].append(number)
    order = [alias for alias in aliases if alias and alias in blocks]
    if sorted([0, *order]) != sorted(blocks):
        return tuple(range(len(expected)))
    return tuple(number for alias in (0, *order) for number in blocks[alias])


def iter_differences(
    expected: Sequence[ExpectedSlave], found: Sequence[FoundSlave]
) -> Iterator[str]:
    """Yield one line a difference; a missing slave does not make all behind it different.

    With as many slaves as expected, position is compared with position.
    """
    if len(expected) == len(found):
        for each, slave in zip(expected, found, strict=True):
            yield from _compare(each, slave)
        return
    matcher = SequenceMatcher(
        None,
        [(each.vendor, each.product) for each in expected],
        [(each.identity.vendor, each.identity.product) for each in found],
        autojunk=False,
    )
    for _, start, end, there, there_end in matcher.get_opcodes():
        pairs = min(end - start, there_end - there)
        for offset in range(pairs):
            yield from _compare(expected[start + offset], found[there + offset])
        for missing in expected[start + pairs : end]:
            before = f"after {found[there - 1 + pairs].name}" if there + pairs else "at the start"
            yield f"{missing.name} is missing {before}, expected {_describe(missing)}"
        for slave in found[there + pairs : there_end]:
            yield f"{_place(slave)}: {slave.fault or slave.identity}, expected no slave here"


def _compare(expected: ExpectedSlave, slave: FoundSlave) -> Iterator[str]:
    if slave.fault:
        yield f"{_place(slave)}: {slave.fault}, expected {expected.name}"
    elif not fits(expected, slave.identity):
        serial = f", serial {slave.identity.serial}" if expected.serial is not None else ""
        yield (
            f"{_place(slave)}: {slave.identity}{serial},"
            f" expected {expected.name} with {_describe(expected)}"
        )
    elif expected.alias not in {None, slave.alias}:
        yield (
            f"{_place(slave)}: alias {slave.alias}, expected {expected.name} with alias"
            f" {expected.alias}"
        )


def _place(slave: FoundSlave) -> str:
    return f"position {slave.position} (station {slave.station})"


def _describe(expected: ExpectedSlave) -> str:
    text = f"vendor 0x{expected.vendor:08X}, product 0x{expected.product:08X}"
    if expected.revision is not None:
        text += f", revision 0x{expected.revision:08X}"
    if expected.serial is not None:
        text += f", serial {expected.serial}"
    return text
