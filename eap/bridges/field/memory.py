"""Memory that clients of a server read and write: areas of bytes, in which variables lie.

Rule 1: a read shows variables as they are now, zeros between them, and ends before the first byte
behind the last variable of the area.
Rule 2: a write is done as a whole or refused as a whole.  It may cover variables that clients must
not write, and gaps, as long as it leaves them as they are: panels write whole blocks.
A variable that holds NaN is left as it is by a write that leaves it.
Rule 3: of a variable that a write covers in part the other bytes keep their values.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from enum import Enum
from typing import Any, NamedTuple

from eap.codec.datatypes import is_finite, with_nan
from eap.codec.fieldaddresses import FieldPoint, place_text, unit_bits
from eap.codec.fieldtypes import get_bits, put_bits


class Denial(Enum):
    """Reason of a refused read or write."""

    ADDRESS = "no such address"
    READ_ONLY = "the plant file does not let clients write it"
    VALUE = "no value of the variable"
    NO_VALUE = "the variable has no value yet"
    REFUSED = "refused by the plant"


class DeniedError(Exception):
    """A read or write that is refused.

    Attributes:
        denial: Why.
    """

    def __init__(self, denial: Denial, why: str) -> None:
        super().__init__(why)
        self.denial = denial


class ServedPoint(NamedTuple):
    """A variable that is served; *name* is ``STATION/VARIABLE``."""

    name: str
    point: FieldPoint
    write: bool


class _Area:
    """Bytes of one area, and the variables in it in the order of their addresses."""

    def __init__(self, points: list[ServedPoint]) -> None:
        self.points = sorted(points, key=lambda each: each.point.place.bit)
        self.starts = [each.point.place.bit for each in self.points]
        self.longest = max(each.point.type.bits for each in self.points)
        unit = unit_bits(points[0].point.place.area)
        end = max(each.point.end for each in points)
        # Clients read whole registers and bytes, also where the last variable ends within one.
        self.bits = end + -end % unit
        self.data = bytearray(-(-self.bits // 8))

    def covering(self, start: int, bits: int) -> list[ServedPoint]:
        """Return the variables that have bits in a range."""
        # A variable that begins before that ends before the range.
        first = bisect_left(self.starts, start - self.longest + 1)
        last = bisect_right(self.starts, start + bits - 1)
        return [each for each in self.points[first:last] if each.point.end > start]


class ServedMemory:
    """All areas of one server.

    Args:
        points: The variables with their addresses.
    """

    def __init__(self, points: Iterable[ServedPoint]) -> None:
        by_area: dict[str, list[ServedPoint]] = {}
        self._by_name: dict[str, list[ServedPoint]] = {}
        for each in points:
            by_area.setdefault(each.point.place.area, []).append(each)
            self._by_name.setdefault(each.name, []).append(each)
        self._areas = {name: _Area(own) for name, own in by_area.items()}
        self._missing = set(self._by_name)

    @property
    def names(self) -> list[str]:
        """Names of all variables."""
        return list(self._by_name)

    def has_area(self, area: str) -> bool:
        """Return whether variables lie in *area*."""
        return area in self._areas

    def update(self, name: str, plain: Any) -> str:
        """Show a new value; return why that is not possible, and it keeps the one before."""
        for _, point, _ in self._by_name.get(name, ()):
            try:
                data = point.type.encode(point.type.kind.from_plain(with_nan(plain)))
            except ValueError as exc:
                return f"{name}: {exc}"
            put_bits(self._areas[point.place.area].data, point.place.bit, point.type.bits, data)
            self._missing.discard(name)
        return ""

    def read(self, area: str, start: int, bits: int) -> bytes:
        """Return *bits* bits from *start* on, the first as bit 0 of the first byte.

        Raises:
            DeniedError: there are not so many, or a variable there has no value yet.
        """
        found = self._range(area, start, bits)
        for each in found.covering(start, bits):
            if each.name in self._missing:
                raise DeniedError(Denial.NO_VALUE, f"{each.name} has no value yet")
        return _bits(found.data, start, bits)

    def changes(self, area: str, start: int, bits: int, data: bytes) -> dict[str, Any]:
        """Return the new values of variables, in plain form, that a write asks for.

        Raises:
            DeniedError: it is refused as a whole.
        """
        found = self._range(area, start, bits)
        wanted = bytearray(found.data)
        _put(wanted, start, bits, data)
        rest = bytearray(wanted)
        changes: dict[str, Any] = {}
        for name, point, is_writable in found.covering(start, bits):
            place, kind = point.place.bit, point.type
            before = get_bits(found.data, place, kind.bits)
            after = get_bits(wanted, place, kind.bits)
            # What still differs in the end lies in no variable.
            put_bits(rest, place, kind.bits, before)
            if is_writable:
                # Also one with the same value: somebody else may have set another one meanwhile.
                try:
                    value = kind.decode(after)
                except ValueError as exc:
                    raise DeniedError(Denial.VALUE, f"{name}: {exc}") from None
                if is_finite(value):
                    changes[name] = kind.kind.to_plain(value)
                elif before != after:
                    why = f"{name}: clients write neither NaN nor infinite numbers"
                    raise DeniedError(Denial.VALUE, why)
            elif before != after:
                why = f"{name} at {place_text(point)} is not writable"
                raise DeniedError(Denial.READ_ONLY, why)
        if rest != found.data:
            raise DeniedError(Denial.ADDRESS, f"no variable at all bytes from {area}:{start} on")
        if not changes:
            raise DeniedError(Denial.READ_ONLY, f"nothing writable at {area}:{start}")
        return changes

    def _range(self, area: str, start: int, bits: int) -> _Area:
        found = self._areas.get(area)
        if found is None or start < 0 or bits < 1 or start + bits > found.bits:
            raise DeniedError(Denial.ADDRESS, f"{area} has no {bits} bits from {start} on")
        return found


def _bits(data: bytearray, start: int, bits: int) -> bytes:
    if not start % 8 and not bits % 8:
        return bytes(data[start // 8 : (start + bits) // 8])
    first, last = start // 8, -(-(start + bits) // 8)
    number = int.from_bytes(data[first:last], "little") >> start % 8
    return (number & (1 << bits) - 1).to_bytes(-(-bits // 8), "little")


def _put(data: bytearray, start: int, bits: int, octets: bytes) -> None:
    first, last = start // 8, -(-(start + bits) // 8)
    mask = (1 << bits) - 1 << start % 8
    number = int.from_bytes(octets, "little") << start % 8 & mask
    number |= int.from_bytes(data[first:last], "little") & ~mask
    data[first:last] = number.to_bytes(last - first, "little")
