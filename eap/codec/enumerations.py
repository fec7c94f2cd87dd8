"""Enumerations: numbers with names.

``NAME<BASE:TEXT=NUMBER,…>`` is the text of an enumeration, such as ``E_State<INT:Off=0,On=1>``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Self

from eap.codec.basetypes import DataType, Integer, Plain, Value, whole_number
from eap.codec.wire import Buffer
from eap.suggest import suggest

MAX_MEMBERS = 4096
"""Names of an enumeration, and members of a struct."""
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}", re.ASCII)


def check_name(owner: str, name: str) -> None:
    """Raise ValueError if *name* is none for a member of *owner*."""
    if not _IDENTIFIER.fullmatch(name):
        raise ValueError(f"{owner} has a member {name[:60]!r}: expected letters, digits and _")


class EnumValue(int):
    """A number of an enumeration: an ``int`` with the *name* that it has there, "" for none."""

    name: str

    def __new__(cls, number: int, name: str) -> Self:
        """Make the value *number*."""
        value = super().__new__(cls, number)
        value.name = name
        return value

    def __str__(self) -> str:
        return self.name or int.__repr__(self)

    def __repr__(self) -> str:
        return f"EnumValue({int.__repr__(self)}, {self.name!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return EnumValue, (int(self), self.name)


class Enumeration(Integer, frozen=True):
    """Numbers with names; its value is an EnumValue, and a name or a number when writing."""

    names: Mapping[int, str] = {}
    """First name of each number."""
    numbers: Mapping[str, int] = {}
    """By name, in the order of the definition."""
    base: str = ""
    """Text of the type of its numbers."""

    @property
    def scalar_range(self) -> None:  # type: ignore[override]  # it is no number for users
        """None: links and sources of numbers do not fit."""
        return None

    def compose(self, seen: dict[str, DataType]) -> str:
        """Return the name if the definition precedes it, else the definition."""
        if self.alias_of:
            return super().compose(seen)
        if seen.get(self.name) == self:
            return self.name
        seen[self.name] = self
        return self.text

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a name or a number that the enumeration has."""
        number = self._number(value) if isinstance(value, str) else value
        if isinstance(number, int) and number in self.names and not isinstance(number, bool):
            return int(number).to_bytes(self.size, "little", signed=self.signed)
        listed = ", ".join(f"{name} ({number})" for name, number in list(self.numbers.items())[:8])
        more = ", …" if len(self.numbers) > 8 else ""
        hint = suggest(value, self.numbers) if isinstance(value, str) else ""
        raise self._refuse(value, f"{listed}{more}{hint}")

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Return the number; one that the enumeration has not is one without a name."""
        number = int.from_bytes(buffer[offset : offset + self.size], "little", signed=self.signed)
        return EnumValue(number, self.names.get(number, ""))

    def parse_text(self, text: str) -> Value:
        """Read a name, also behind that of the type and a dot, or a number."""
        word = text.strip()
        try:
            return self.decode(self.encode(whole_number(word)), 0)
        except ValueError:
            return self.decode(self.encode(word), 0)

    def to_plain(self, value: Value) -> Plain:
        """Return the name, or a number without one."""
        if isinstance(value, str):
            return value
        number = int(value)
        return self.names.get(number, number)

    def _number(self, text: str) -> int | None:
        name = text.rpartition(".")[2]
        if name in self.numbers:
            return self.numbers[name]
        # IEC 61131-3 knows no case.
        folded = [n for each, n in self.numbers.items() if each.casefold() == name.casefold()]
        return folded[0] if len(folded) == 1 else None


def make_enumeration(name: str, base: DataType, numbers: Mapping[str, int]) -> Enumeration:
    """Return the enumeration *name*; raise ValueError if a number does not fit the base."""
    if type(base) is not Integer or base.is_bits or base.bounds:
        raise ValueError(f"{name} has the base {base.name}: expected a whole number such as INT")
    if not numbers:
        raise ValueError(f"{name} has no values: an enumeration needs at least one")
    if len(numbers) > MAX_MEMBERS:
        raise ValueError(f"{name} has {len(numbers)} values, at most {MAX_MEMBERS}")
    names: dict[int, str] = {}
    for each, number in numbers.items():
        check_name(name, each)
        try:
            base.encode(number)
        except ValueError as exc:
            raise ValueError(f"{each} of {name}: {exc}") from None
        names.setdefault(number, each)
    listed = ",".join(f"{each}={number}" for each, number in numbers.items())
    return Enumeration(
        f"{name}<{base.text}:{listed}>",
        base.code,
        base.bit_length,
        base.size,
        name=name,
        signed=base.signed,
        names=names,
        numbers=dict(numbers),
        base=base.text,
    )
