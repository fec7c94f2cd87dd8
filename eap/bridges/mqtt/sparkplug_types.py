"""Values of the plant as metrics of Sparkplug B, and back.

A struct is a template, an array of structs or of single values a data set with a row for each
element, an enumeration its text.  What fits none of these (an array of several dimensions or of
arrays, times) is text: JSON of arrays, the plain form of times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from eap.codec.arrays import Array
from eap.codec.basetypes import Block, Boolean, DataType, Integer, Real
from eap.codec.enumerations import Enumeration
from eap.codec.sparkplug import DataSet, Metric, MetricType, Template, signed
from eap.codec.structures import Structure
from eap.codec.times import Timed

COLUMN = "value"
"""Name of the column of an array of single values."""
_SIZES = ((1, 0), (2, 1), (4, 2), (8, 3))


def metric_type(kind: DataType) -> MetricType:
    """Return the type of the metric of a variable."""
    if isinstance(kind, Structure):
        return MetricType.TEMPLATE
    if isinstance(kind, Array):
        return MetricType.DATA_SET if _columns(kind) else MetricType.STRING
    return _single_type(kind) or MetricType.STRING


def _single_type(kind: DataType) -> MetricType | None:
    """Return the type of a value without parts, None of one that has some."""
    if isinstance(kind, Structure | Array):
        return None
    if isinstance(kind, Boolean):
        return MetricType.BOOLEAN
    if isinstance(kind, Integer) and not isinstance(kind, Enumeration | Timed):
        first = MetricType.INT8 if kind.signed else MetricType.UINT8
        return MetricType(first + next(n for size, n in _SIZES if kind.size <= size))
    if isinstance(kind, Real):
        return MetricType.FLOAT if kind.size == 4 else MetricType.DOUBLE
    return MetricType.BYTES if isinstance(kind, Block) else MetricType.STRING


def _columns(kind: Array) -> dict[str, MetricType]:
    """Return the columns of the data set of an array, none if it is no table."""
    if len(kind.dimensions) > 1:
        return {}
    element = kind.element
    if isinstance(element, Structure):
        types = {name: _table_type(member.kind) for name, member in element.by_name.items()}
    else:
        types = {COLUMN: _table_type(element)}
    return {} if None in types.values() else {name: each for name, each in types.items() if each}


def _table_type(kind: DataType) -> MetricType | None:
    found = _single_type(kind)
    return MetricType.STRING if found is MetricType.BYTES else found  # a table has no bytes


class TemplateTypes:
    """Definitions of the templates of a node, one for each struct; names are unique."""

    def __init__(self) -> None:
        self._names: dict[str, str] = {}
        self._kinds: dict[str, Structure] = {}

    def add(self, kind: DataType) -> None:
        """Add the structs of *kind*."""
        if isinstance(kind, Array) and not _columns(kind):
            return
        if not isinstance(kind, Structure) or kind.text in self._names:
            return
        for member in kind.members:
            self.add(member.kind)
        name, number = kind.name, 1
        while name in self._kinds:
            number += 1
            name = f"{kind.name}_{number}"
        self._names[kind.text] = name
        self._kinds[name] = kind

    def definitions(self) -> list[Metric]:
        """Return the metrics that define them, those that others use first."""
        return [
            Metric(
                name,
                MetricType.TEMPLATE,
                Template(
                    [
                        Metric(m.name, metric_type(m.kind), self._default(m.kind))
                        for m in kind.members
                    ],
                    is_definition=True,
                ),
            )
            for name, kind in self._kinds.items()
        ]

    def value(self, kind: DataType, plain: Any) -> Any:
        """Return the value of a metric for a plain one."""
        if plain is None:
            return None
        if isinstance(kind, Structure):
            members = [
                Metric(m.name, metric_type(m.kind), self.value(m.kind, plain.get(m.name)))
                for m in kind.members
            ]
            return Template(members, self._names[kind.text])
        if isinstance(kind, Array):
            return _table(kind, plain)
        if isinstance(kind, Block):
            return bytes.fromhex(plain)
        return plain if isinstance(kind, Boolean | Real) else _scalar(kind, plain)

    def _default(self, kind: DataType) -> Any:
        return self.value(kind, kind.to_plain(kind.zero))


def _scalar(kind: DataType, plain: Any) -> Any:
    return str(plain) if metric_type(kind) is MetricType.STRING else plain


def _table(kind: Array, plain: Any) -> Any:
    columns = _columns(kind)
    if not columns:
        return msgspec.json.encode(plain).decode()
    if isinstance(kind.element, Structure):
        rows = [[_element(each[name], columns[name]) for name in columns] for each in plain]
    else:
        rows = [[_element(each, columns[COLUMN])] for each in plain]
    return DataSet(list(columns), list(columns.values()), rows)


def _element(plain: Any, kind: MetricType) -> Any:
    return str(plain) if kind is MetricType.STRING else plain


def plain_value(kind: DataType, metric: Metric, present: Any) -> Any:
    """Return the plain value of a command.

    Args:
        kind: Type of the variable.
        metric: The command; it may have no type.
        present: Present plain value, for members that a template does not have.

    Raises:
        ValueError: it is no value of the type.
    """
    value = metric.value
    if value is None:
        raise ValueError("a command of null: expected a value")
    if isinstance(kind, Structure):
        return _plain_struct(kind, value, present)
    if isinstance(kind, Array):
        return _plain_array(kind, value)
    if isinstance(value, Template | DataSet):
        raise ValueError(f"a table or struct: expected a value of {kind.name}")  # noqa: TRY004
    if isinstance(value, bytes):
        return value.hex()
    own = metric_type(kind)
    if isinstance(value, int) and not isinstance(value, bool) and isinstance(kind, Integer):
        return signed(value, metric.kind or own)
    if own is MetricType.STRING and isinstance(kind, Integer) and str(value).isdecimal():
        return int(value)
    return value


def _plain_struct(kind: Structure, value: Any, present: Any) -> dict[str, Any]:
    if not isinstance(value, Template):
        raise ValueError(f"no template: expected one of {kind.name}")  # noqa: TRY004
    found: dict[str, Any] = dict(present) if isinstance(present, Mapping) else {}
    for each in value.metrics:
        member = kind.by_name.get(each.name)
        if member is None:
            raise ValueError(f"{kind.name} has no member {each.name!r}")
        found[each.name] = plain_value(member.kind, each, found.get(each.name))
    return found


def _plain_array(kind: Array, value: Any) -> Any:
    if isinstance(value, str):
        try:
            return msgspec.json.decode(value)
        except (ValueError, RecursionError):
            raise ValueError("no JSON: expected an array") from None
    if not isinstance(value, DataSet):
        raise ValueError("no data set: expected one with a row for each element")  # noqa: TRY004
    if isinstance(kind.element, Structure):
        return [dict(zip(value.columns, row, strict=True)) for row in value.rows]
    return [row[0] if row else None for row in value.rows]
