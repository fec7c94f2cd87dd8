"""Filter of rows by an expression, such as ``lost>0`` or ``island state!=OP``.

Each word is a condition, and a row has to fulfil all of them.  ``KEY OP VALUE`` without spaces
compares a field; any other word has to be in one of the texts of the row, in any case.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import msgspec

from eap.patterns import compile_patterns
from eap.suggest import suggest

_OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    "==": operator.eq,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}
_CONDITION = re.compile(r"([A-Za-z_]\w*)(>=|<=|!=|==|>|<|=)(.*)")
_QUANTITY = re.compile(r"([0-9.]+)(us|µs|ms|s)?")
_UNITS_US = {"us": 1, "µs": 1, "ms": 1000, "s": 1_000_000}
_SHORT = {
    "tx": "tx_per_s",
    "rx": "rx_per_s",
    "age": "age_us",
    "jitter": "jitter_p99_us",
    "hz": "per_s",
    "pd": "name",
}
"""Short forms of keys."""


class _Condition(NamedTuple):
    key: str
    operator: str
    number: float | None
    fits: Callable[[str], bool] | None

    def holds(self, row: msgspec.Struct) -> bool:
        value = getattr(row, self.key, None)
        if isinstance(value, str) and self.fits is not None:
            is_equal = self.fits(value.casefold())
            return is_equal if self.operator in {"=", "=="} else not is_equal
        if value is None or self.number is None:
            return False
        return _OPERATORS[self.operator](value, self.number)


class RowFilter:
    """Parsed expression; an empty one fits all rows."""

    def __init__(self, conditions: Sequence[_Condition] = (), words: Sequence[str] = ()) -> None:
        self._conditions = conditions
        self._words = words

    @classmethod
    def parse(cls, text: str, *kinds: type[msgspec.Struct]) -> RowFilter:
        """Read an expression about rows of *kinds*.

        Raises:
            ValueError: a key, an operator or a value does not fit the rows.
        """
        fields = {name: kind for each in kinds for name, kind in _fields_of(each).items()}
        conditions, words = [], []
        for word in text.split():
            if (found := _CONDITION.fullmatch(word)) is None:
                words.append(word.casefold())
            else:
                conditions.append(_condition(found[1], found[2], found[3], fields))
        return cls(conditions, words)

    def fits(self, row: msgspec.Struct) -> bool:
        """Return whether a row fulfils all conditions."""
        if not all(each.holds(row) for each in self._conditions):
            return False
        if not self._words:
            return True
        values = (getattr(row, name) for name in row.__struct_fields__)
        text = "\n".join(value.casefold() for value in values if isinstance(value, str))
        return all(word in text for word in self._words)


def _fields_of(kind: type[msgspec.Struct]) -> dict[str, bool]:
    """Return the fields of a kind of rows, and whether each is a text."""
    found = {}
    for field in msgspec.structs.fields(kind):
        info = msgspec.inspect.type_info(field.type)
        found[field.name] = isinstance(info, msgspec.inspect.StrType | msgspec.inspect.LiteralType)
    return found


def _condition(key: str, sign: str, value: str, fields: dict[str, bool]) -> _Condition:
    name = _SHORT.get(key, key)
    if name not in fields:
        known = [*fields, *(short for short, full in _SHORT.items() if full in fields)]
        raise ValueError(f"no key {key!r}{suggest(key, known) or _listed(known)}")
    if fields[name]:
        if sign not in {"=", "==", "!="}:
            raise ValueError(f"{key} is a text: compare it by = or !=")
        return _Condition(name, sign, None, compile_patterns([value.casefold()]))
    if (found := _QUANTITY.fullmatch(value)) is None or (found[2] and not name.endswith("_us")):
        unit = ", with us, ms or s" if name.endswith("_us") else ""
        raise ValueError(f"{key}{sign}{value}: expected a number{unit}")
    try:
        number = float(found[1]) * _UNITS_US.get(found[2], 1)
    except ValueError:
        raise ValueError(f"{key}{sign}{value}: expected a number") from None
    return _Condition(name, sign, number, None)


def _listed(known: Iterable[str]) -> str:
    return f"; known keys: {', '.join(known)}"
