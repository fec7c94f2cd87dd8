"""Other layouts of an RxPD, which are taken while its sender changes from one to the other.

What both layouts have goes to its place in the image, and so does the quality, which says how old
it is.  What only the RxPD has keeps its value, and its PD header in the image stays as it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eap.codec import datatypes, pdo
from eap.codec.datatypes import DataType
from eap.codec.pd import PdHeader
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.spec import Record, RxAlternateSpec, RxPdSpec

_QUALITY_BITS = 16
"""The quality is the last field of a PD header."""
_QUALITY = 8 * PdHeader.SIZE - _QUALITY_BITS


class AlternatePlace(Record, frozen=True):
    """Another layout: *size* octets of data."""

    version: int
    size: int
    moves: tuple[Move, ...]
    """From bits of the PD, header included, to bits of the image."""
    untouched: tuple[tuple[int, int], ...]
    """Variables of the RxPD that it does not bring: first bit in the image, and how many."""

    def copy_plan(self) -> CopyPlan:
        """Return what copies a PD of this layout, header included, to the image."""
        return CopyPlan(self.moves, used=self.untouched)


def place_alternates(
    pd: RxPdSpec, kinds: Sequence[DataType], bits: Sequence[int], offset: int
) -> tuple[AlternatePlace, ...]:
    """Return where the alternates of *pd* go.

    Args:
        pd: The RxPD.
        kinds: Types of its variables, in PDO order.
        bits: Where they lie in the image.
        offset: Octet of the image at which its PD header lies.

    Raises:
        ValueError: an alternate brings what *pd* has not, or has as another type; or the same
            variable twice; or it cannot be told from another layout by version and size.
    """
    if not pd.alternates:
        return ()
    own = dict(zip(pd.variables, zip(kinds, bits, strict=True), strict=True))
    layouts = {(pd.version, pdo.layout(kinds).size)}
    found = []
    for alternate in pd.alternates:
        found.append(_place(pd, alternate, own, 8 * offset))
        key = found[-1].version, found[-1].size
        if key in layouts:
            problem = f"has {key[1]} octets like another layout of that version"
            raise _refusal(pd, alternate, problem, "another version")
        layouts.add(key)
    return tuple(found)


def _place(
    pd: RxPdSpec, alternate: RxAlternateSpec, own: Mapping[str, tuple[DataType, int]], header: int
) -> AlternatePlace:
    theirs = [datatypes.parse(each.type) for each in alternate.variables]
    plan = pdo.layout(theirs)
    moves = [Move(_QUALITY, header + _QUALITY, _QUALITY_BITS)]
    missing = dict(own)
    for each, kind, start in zip(alternate.variables, theirs, plan.bit_offsets, strict=True):
        if not each.name:
            continue
        expected, bit = missing.pop(each.name, (None, 0))
        if kind != expected:
            shown = ", ".join(f"{name} ({own[name][0].text})" for name in own)
            problem = f"brings {each.name} ({kind.text})"
            raise _refusal(pd, alternate, problem, f"each of {shown} at most once")
        moves.append(Move(8 * PdHeader.SIZE + start, bit, kind.bit_length))
    untouched = tuple((bit, kind.bit_length) for kind, bit in missing.values())
    return AlternatePlace(alternate.version, plan.size, tuple(moves), untouched)


def _refusal(pd: RxPdSpec, alternate: RxAlternateSpec, problem: str, expected: str) -> ValueError:
    which = f"alternate of version {alternate.version} of RxPD {pd.name!r}"
    return ValueError(f"{which} {problem}, expected {expected}")
