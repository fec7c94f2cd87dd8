"""Data types of a plant file, with the layout of their members."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from eap.codec.basetypes import DataType
from eap.codec.enumerations import Enumeration
from eap.codec.structures import Structure, member_type_name
from eap.config.types import TypeTable
from eap.errors import ConfigError
from eap.runtime.plantfile import load_plant
from eap.suggest import suggest

_MANY = 12
"""Names of types in a message."""


class LayoutRow(msgspec.Struct, frozen=True):
    """A member, or with an empty name padding; both numbers in bits."""

    name: str
    type: str
    bit_offset: int
    bits: int


class ShownType(msgspec.Struct, frozen=True, kw_only=True):
    """One type.

    Attributes:
        name: Its name.
        kind: ``struct``, ``union``, ``enum`` or ``alias``.
        size: In bytes.
        alignment: In bytes.
        text: Its complete text.
        layout: Members of a struct or union in the order of their places, padding included.
        values: Names and numbers of an enumeration.
        of: Type that an alias is another name of.
    """

    name: str
    kind: str
    size: int
    alignment: int
    text: str
    layout: list[LayoutRow] = []
    values: dict[str, int] = {}
    of: str = ""


def list_types(path: Path, name: str = "") -> list[ShownType]:
    """Return the types that the plant file at *path* defines or uses, or the one called *name*.

    Raises:
        ConfigError: the plant file or the type has an error, or there is no such type.
    """
    result = load_plant(path)
    if result.plant is None or result.types is None:
        raise ConfigError("\n".join(map(str, result.findings)))
    if not name:
        return [_shown(kind) for kind in result.types.resolved()]
    return [_shown(_find(result.types, path, name))]


def _find(table: TypeTable, path: Path, name: str) -> DataType:
    try:
        kind = table.find(name)
    except ValueError:
        raise ConfigError("\n".join(map(str, table.findings()))) from None
    if kind is None:
        known = sorted(table.names())
        more = ", …" if len(known) > _MANY else ""
        hint = suggest(name, known) or f"; types: {', '.join(known[:_MANY])}{more}"
        raise ConfigError(f"{path}: no type {name!r}{hint}")
    return kind


def _shown(kind: DataType) -> ShownType:
    values: dict[str, int] = {}
    layout: list[LayoutRow] = []
    form = "alias"
    if kind.alias_of is None and isinstance(kind, Structure):
        form = "union" if kind.is_union else "struct"
        layout = sorted(_rows(kind), key=lambda row: row.bit_offset)
    elif kind.alias_of is None and isinstance(kind, Enumeration):
        form, values = "enum", dict(kind.numbers)
    return ShownType(
        name=kind.name,
        kind=form,
        size=kind.size,
        alignment=kind.alignment,
        text=kind.text,
        layout=layout,
        values=values,
        of="" if kind.alias_of is None else kind.alias_of.name,
    )


def _rows(kind: Structure) -> Iterator[LayoutRow]:
    for name, member, bit_offset in kind.members:
        yield LayoutRow(name, member_type_name(member), bit_offset, member.bit_length)
    for bit_offset, bits in kind.gaps():
        yield LayoutRow("", "", bit_offset, bits)
