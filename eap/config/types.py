"""Data types of a plant: definitions of its section ``types``, and of the files named there.

All types are resolved right after the file is read: later code sees variables with complete texts.
A type of a file is resolved when it is used, because files of controllers also have types that no
variable can have, such as function blocks with pointers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.enumerations import make_enumeration
from eap.codec.structures import (
    MAX_DEPTH,
    Member,
    Structure,
    lay_out_structure,
    place_structure,
)
from eap.config.finding import FindingReport, PlantFinding
from eap.config.plant_sections import PlantFile
from eap.config.structs import StationSection, TypeSection, VariableSection

if TYPE_CHECKING:
    from eap.config.imports.typefile import ArrayBound, TypeRecord

MAX_TYPE_FILE = 64 << 20
"""Bytes of the largest file of types."""
_CHUNK = 1 << 16
_MANY_ROWS = 50
"""Members of a layout in a finding; of larger ones only those that differ."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,254}", re.ASCII)
A_TYPE = "a data type such as UINT, REAL or BLOCK(64)"


class MemberDefinition(msgspec.Struct, frozen=True, kw_only=True):
    """A member as it is defined; *bit_offset* and *bits* are None where nothing says them."""

    name: str
    type: str
    bit_offset: int | None = None
    bits: int | None = None
    path: str = ""
    line: int = 0


class TypeDefinition(msgspec.Struct, frozen=True, kw_only=True):
    """A type as it is defined, with references to other types by name.

    Attributes:
        name: Its name.
        base: Base of an enumeration, or the type that *name* is an alias of.
        values: Names and numbers of an enumeration.
        members: Those of a struct or union.
        is_union: All members begin at 0.
        extends: Struct whose members come first.
        pack: Largest alignment of a member, in bytes.
        bits: Its size; 0 where nothing says it.
        file: File that has it; empty for the plant file.
        path: In the plant file.
        line: In another file.
        is_reported: It had a finding when it was read.
    """

    name: str
    base: str = ""
    values: tuple[tuple[str, int], ...] = ()
    members: tuple[MemberDefinition, ...] = ()
    is_union: bool = False
    extends: str = ""
    pack: int = 8
    bits: int = 0
    file: str = ""
    path: str = ""
    line: int = 0
    is_reported: bool = False


class ReportedTypeError(ValueError):
    """The type was reported; what refers to it needs no finding."""


class TypeTable:
    """Types by name, resolved when they are used.

    Args:
        definitions: In the order of the files; a name that occurs twice is a finding, in files of
            controllers when it is used.
        report: Takes the findings.
    """

    def __init__(self, definitions: Iterable[TypeDefinition], report: FindingReport) -> None:
        self._report = report
        self._definitions: dict[str, TypeDefinition] = {}
        self._found: dict[str, DataType] = {}
        self._broken: set[str] = set()
        self._open: list[str] = []
        self._twice: dict[str, tuple[TypeDefinition, str]] = {}
        """Names that two files define differently, with the second one and its finding."""
        for each in definitions:
            self._add(each)

    def __iter__(self) -> Iterator[TypeDefinition]:
        return iter(self._definitions.values())

    def names(self) -> Iterable[str]:
        """Return all names."""
        return [each.name for each in self]

    def resolved(self) -> list[DataType]:
        """Return the types that were used so far."""
        return list(self._found.values())

    def findings(self) -> tuple[PlantFinding, ...]:
        """Return all findings of the report."""
        return self._report.findings()

    def find(self, name: str) -> DataType | None:
        """Return the type called *name*, None if there is none.

        Raises:
            ValueError: it has a finding.
        """
        key = name.upper()
        if key not in self._definitions:
            key = key.rpartition(".")[2]  # the name of a library before it
        if key in self._found:
            return self._found[key]
        definition = self._definitions.get(key)
        if definition is None:
            return None
        if key in self._broken or definition.is_reported:
            raise ReportedTypeError(name)
        if key in self._twice:
            self._broken.add(key)
            raise self._reported(*self._twice[key], "a file with one type of that name")
        # A type that has itself as a part would never end.
        if key in self._open or len(self._open) >= MAX_DEPTH:
            raise self._too_deep(key, definition)
        self._open.append(key)
        try:
            kind = self._build(definition)
        except ReportedTypeError:
            self._broken.add(key)
            raise
        finally:
            self._open.pop()
        self._found[key] = kind
        return kind

    def parse(self, text: str) -> DataType:
        """Return the type that *text* names.

        Raises:
            ValueError: there is none, or it has a finding.
        """
        return datatypes.parse_with(text, self)

    def _add(self, each: TypeDefinition) -> None:
        key = each.name.upper()
        if not _NAME.fullmatch(each.name) or datatypes.is_base_name(each.name):
            # Files have types with names such as ARRAY [1..3] OF ST_A, which are read as such.
            if not each.file:
                message = f"{each.name[:60]!r} is no name of a type of its own"
                self._add_finding(each, message, "letters, digits and _, and no base type's name")
            return
        if key in self._definitions:
            first = self._definitions[key]
            where = f"{first.file or 'line'} {first.line or self._report.line_of(first.path)}"
            message = f"type {each.name} is defined twice (first in {where})"
            if not each.file or not first.file:
                self._add_finding(each, message, "each name once")
            elif not _same(first, each):
                # Libraries have types of one name; that matters only where one is used.
                self._twice.setdefault(key, (each, message))
            return
        self._definitions[key] = each

    def _build(self, each: TypeDefinition) -> DataType:
        try:
            kind = self._make(each)
            # Complete texts are read by other processes: their limits hold here already.
            return datatypes.parse(kind.text)
        except ReportedTypeError:
            raise
        except ValueError as exc:
            what, _, expected = str(exc).partition(": expected ")
            message = what if each.name in what else f"{each.name}: {what}"
            raise self._reported(each, message, expected or "a type of known parts") from None

    def _make(self, each: TypeDefinition) -> DataType:
        if each.values:
            numbers = dict(each.values)
            if len(numbers) < len(each.values):
                raise ValueError(f"{each.name} has a name twice: expected each name once")
            kind: DataType = make_enumeration(each.name, self.parse(each.base or "INT"), numbers)
        elif each.members or each.extends:
            return self._structure(each)
        elif not each.base:
            raise ValueError(f"{each.name} has no members: expected a type with values")
        else:
            _refuse_pointer(each.name, each.base)
            kind = datatypes.byte_bool(self.parse(each.base)).named(each.name)
        if each.bits and kind.bit_length != each.bits:
            raise ValueError(
                f"{each.name} has {each.bits} bits in {each.file}, as {kind.wire} it has"
                f" {kind.bit_length}: expected the same size"
            )
        return kind

    def _structure(self, each: TypeDefinition) -> Structure:
        base = self._base(each)
        kinds = self._members(each)
        _check_names(each, base)
        plan = [(member.name, kind) for member, kind in kinds]

        def compiled() -> Structure:
            return lay_out_structure(
                each.name, plan, pack=each.pack, base=base, union=each.is_union
            )

        placed = [member.bit_offset for member in each.members]
        if not each.members or all(offset is None for offset in placed):
            kind = compiled()
            if each.bits in {0, kind.bit_length}:
                return kind
        elif any(offset is None for offset in placed):
            raise ValueError(f"{each.name} has an offset for some members: expected it for all")
        else:
            fixed = [Member(m.name, kind, m.bit_offset or 0) for m, kind in kinds]
            sizes = [kind.bit_length if m.bits is None else m.bits for m, kind in kinds]
            agrees = each.bits % 8 == 0 and sizes == [kind.bit_length for _, kind in kinds]
            own = [*(base.members if base else ()), *fixed]
            end = max((member.end for member in own), default=0)
            if agrees and end <= (each.bits or end):
                size = each.bits // 8 if each.bits else None
                return place_structure(each.name, own, size=size, pack=each.pack)
        raise self._contradiction(each, kinds, compiled)

    def _base(self, each: TypeDefinition) -> Structure | None:
        if not each.extends:
            return None
        base = self.parse(each.extends)
        if isinstance(base, Structure):
            return base
        raise ValueError(f"{each.name} extends {base.name}: expected a struct")

    def _members(self, each: TypeDefinition) -> list[tuple[MemberDefinition, DataType]]:
        """Return the members with their types, after all of them had their findings."""
        kinds = []
        broken: ReportedTypeError | None = None
        for member in each.members:
            try:
                kinds.append((member, self._member(each, member)))
            except ReportedTypeError as exc:
                broken = exc
        if broken:
            raise broken
        return kinds

    def _member(self, each: TypeDefinition, member: MemberDefinition) -> DataType:
        try:
            _refuse_pointer(f"{member.name} of {each.name}", member.type)
            text = "BOOL" if member.type.upper() == "BIT" and member.bits == 8 else member.type
            return datatypes.byte_bool(self.parse(text))
        except ReportedTypeError:
            raise
        except ValueError as exc:
            what, _, expected = str(exc).partition(": expected ")
            own = f"{member.name} of {each.name}"
            message = what if what.startswith(own) else f"{own}: {what}"
            where = msgspec.structs.replace(each, path=member.path, line=member.line)
            raise self._reported(where, message, expected or A_TYPE) from None

    def _contradiction(
        self,
        each: TypeDefinition,
        kinds: list[tuple[MemberDefinition, DataType]],
        compiled: Callable[[], Structure],
    ) -> ValueError:
        """Return the error of a size that is not that of the members, with both layouts."""
        other: Structure | None = None
        with suppress(ValueError):
            other = compiled()
        wrong = [(m, kind) for m, kind in kinds if m.bits not in {None, kind.bit_length}]
        if wrong:
            member, kind = wrong[0]
            message = (
                f"{member.name} of {each.name} has {_bytes(member.bits or 0)} there,"
                f" as {kind.name} {_bytes(kind.bit_length)}"
            )
        else:
            ends = ((m.bit_offset or 0) + kind.bit_length for m, kind in kinds)
            size = max(ends, default=0) if other is None else other.bit_length
            message = f"{each.name} has {_bytes(each.bits)} there, {_bytes(size)} by its members"
        table = "\n".join(_side_by_side(each, kinds, other))
        return self._reported(each, message, f"one size:\n{table}")

    def _too_deep(self, key: str, each: TypeDefinition) -> ValueError:
        chain = [self._definitions[name].name for name in self._open]
        if key in self._open:
            loop = [*chain[self._open.index(key) :], each.name]
            message = f"types contain themselves: {' → '.join(loop)}"
            return self._reported(each, message, "one of them without the next")
        message = f"{chain[0]} is nested too deeply"
        return self._reported(each, message, f"at most {MAX_DEPTH} levels")

    def _reported(self, each: TypeDefinition, message: str, expected: str) -> ReportedTypeError:
        self._add_finding(each, message, expected)
        return ReportedTypeError(each.name)

    def _add_finding(self, each: TypeDefinition, message: str, expected: str) -> None:
        if each.file:
            finding = PlantFinding(each.file, each.line, each.name, message, expected)
            self._report.adopt([finding])
        else:
            self._report.add(each.path, message, expected)


def _check_names(each: TypeDefinition, base: Structure | None) -> None:
    # ADS clients and PLC programs know no case: one of two such members could not be reached.
    seen: dict[str, str] = {}
    inherited = [member.name for member in base.members] if base else []
    for name in (*inherited, *(member.name for member in each.members)):
        other = seen.setdefault(name.upper(), name)
        if other != name:
            raise ValueError(
                f"{each.name} has members {other} and {name}: expected names that differ in"
                " more than upper and lower case"
            )


_POINTER = "POINTER TO "


def _refuse_pointer(name: str, text: str) -> None:
    if text.startswith(_POINTER) or text.upper() in _POINTERS:
        raise ValueError(f"{name} is a pointer: expected a value, a pointer is none elsewhere")


def _same(first: TypeDefinition, second: TypeDefinition) -> bool:
    """Return whether two files define a type alike, as those of one project do."""

    def bare(each: TypeDefinition) -> TypeDefinition:
        members = tuple(msgspec.structs.replace(m, path="", line=0) for m in each.members)
        return msgspec.structs.replace(each, members=members, file="", path="", line=0)

    return bare(first) == bare(second)


def _bytes(bits: int) -> str:
    return f"{bits} bits" if bits % 8 else f"{bits // 8} bytes"


def _side_by_side(
    each: TypeDefinition,
    kinds: list[tuple[MemberDefinition, DataType]],
    other: Structure | None,
) -> Iterator[str]:
    """Yield the given layout beside that of a compiler, with a mark where they differ."""
    rows = []
    for member, kind in kinds:
        given = _place(member.bit_offset, member.bits)
        ours = other.by_name[member.name].bit_offset if other else None
        rows.append((member.name, given, _place(ours, kind.bit_length), kind.name))
    size = _place(None, other.bit_length) if other else ""
    if len(rows) > _MANY_ROWS:
        rows = [row for row in rows if _differ(row[1], row[2])][:_MANY_ROWS]
    rows.append(("(all)", _place(None, each.bits or None), size, ""))
    width = max(len(name) for name, *_ in rows)
    yield f"  {'':{width}}  {'given':>12}  {'computed':>12}"
    for name, given, computed, kind_name in rows:
        differs = "  differs" if _differ(given, computed) else ""
        yield f"  {name:{width}}  {given:>12}  {computed:>12}  {kind_name}{differs}".rstrip()


def _place(bit_offset: int | None, bits: int | None) -> str:
    where = "" if bit_offset is None else f"at {bit_offset / 8:g}"
    size = "" if bits is None else f"size {bits / 8:g}"
    return " ".join(filter(None, (where, size)))


def _differ(given: str, computed: str) -> bool:
    # What one side does not say differs from nothing.
    parts = dict(zip(*[iter(computed.split())] * 2, strict=True))
    return any(
        parts.get(key) != value for key, value in zip(*[iter(given.split())] * 2, strict=True)
    )


class TypedPlant(NamedTuple):
    """A plant whose variables have the complete texts of their types, and the types."""

    plant: PlantFile
    table: TypeTable


def resolve_types(plant: PlantFile, report: FindingReport, folder: Path) -> TypedPlant:
    """Return *plant* with the complete text of each variable's type; report what is wrong."""
    table = TypeTable(_definitions(plant, report, folder), report)
    if not plant.types:
        return TypedPlant(plant, table)
    for each in list(table):
        if not each.file:
            with suppress(ReportedTypeError):
                table.find(each.name)
    stations = tuple(_resolved(station, table, report) for station in plant.stations)
    return TypedPlant(msgspec.structs.replace(plant, stations=stations), table)


def _resolved(station: StationSection, table: TypeTable, report: FindingReport) -> StationSection:
    def complete(variables: dict[str, VariableSection]) -> dict[str, VariableSection]:
        return {name: _complete(name, each, table, report) for name, each in variables.items()}

    subscribe = tuple(
        each
        if each.variables is None
        else msgspec.structs.replace(each, variables=complete(each.variables))
        for each in station.subscribe
    )
    variables = complete(station.variables)
    return msgspec.structs.replace(station, variables=variables, subscribe=subscribe)


def _complete(
    name: str, variable: VariableSection, table: TypeTable, report: FindingReport
) -> VariableSection:
    try:
        text = table.parse(variable.type).text
    except ReportedTypeError:
        report.broken_types.add(variable.type)
        return variable
    except ValueError as exc:
        report.add_error(f"{variable.at}.type", name, exc, A_TYPE)
        report.broken_types.add(variable.type)
        return variable
    return msgspec.structs.replace(variable, type=text)


def _definitions(plant: PlantFile, report: FindingReport, folder: Path) -> Iterator[TypeDefinition]:
    types = plant.types
    for position, item in enumerate(types if isinstance(types, tuple) else (types,)):
        if isinstance(item, str):
            path = f"types[{position}]"
            yield from _of_file(folder / item, item, path, report)
        else:
            for name, section in item.items():
                yield from _of_section(name, section, report)


def _of_section(name: str, section: TypeSection, report: FindingReport) -> Iterator[TypeDefinition]:
    forms = [key for key in TypeSection.FORMS if getattr(section, key)]
    if len(forms) != 1 and not (section.extends and not forms):
        given = f"has {' and '.join(forms)}" if forms else "defines nothing"
        # An empty one may be what is left of a key that could not be read.
        inside = f"{section.at}."
        if forms or not any(each.path.startswith(inside) for each in report.findings()):
            report.add(section.at, f"type {name} {given}", f"one of {', '.join(TypeSection.FORMS)}")
        yield TypeDefinition(name=name, path=section.at, is_reported=True)
        return
    members = section.members or section.union
    yield TypeDefinition(
        name=name,
        base=section.alias or section.base,
        values=tuple(section.values.items()),
        members=tuple(
            MemberDefinition(
                name=each,
                type=member.type,
                bit_offset=None if member.offset is None else 8 * member.offset + member.bit,
                path=member.at,
            )
            for each, member in members.items()
        ),
        is_union=bool(section.union),
        extends=section.extends,
        pack=section.pack,
        bits=8 * section.size,
        path=section.at,
    )


def _of_file(path: Path, name: str, at: str, report: FindingReport) -> Iterator[TypeDefinition]:
    # Few plants have files of types, and the reader of XML takes long to import.
    from eap.config.imports.records import ImportReport
    from eap.config.imports.typefile import read_type_file

    found = ImportReport()
    try:
        with path.open("rb") as file:
            chunks = _limited(iter(lambda: file.read(_CHUNK), b""))
            types = read_type_file(chunks, str(path), found).types
    except (OSError, ValueError) as exc:
        reason = getattr(exc, "strerror", None) or exc
        report.add(at, f"{name}: {reason}", "a TMC or TPY file, by its path from the plant file on")
        return
    report.adopt(found.findings)
    for each in types:
        yield definition_of(each, str(path))


def _limited(chunks: Iterator[bytes]) -> Iterator[bytes]:
    size = 0
    for chunk in chunks:
        size += len(chunk)
        if size > MAX_TYPE_FILE:
            raise ValueError(f"the file is larger than {MAX_TYPE_FILE >> 20} MiB")
        yield chunk


def definition_of(record: TypeRecord, file: str) -> TypeDefinition:
    """Return the definition of a type of a TwinCAT file, in the terms of this project."""
    kind = record.kind.value
    base = type_text(record.base, record.bounds) if record.base else ""
    if record.is_pointer:
        base = _POINTER + base
    return TypeDefinition(
        name=record.name,
        base=base,
        values=record.values,
        members=tuple(
            MemberDefinition(
                name=each.name,
                type=(_POINTER if each.is_pointer else "") + type_text(each.type, each.bounds),
                bit_offset=each.bit_offset,
                bits=each.bits,
                line=each.line,
            )
            for each in record.members
        ),
        is_union=kind == "union",
        extends=type_text(record.extends) if record.extends else "",
        pack=_PACKS.get(record.pack or 0, 8) if record.pack is not None else 8,
        bits=record.bits,
        file=file,
        line=record.line,
    )


_POINTERS = {"PVOID", "ITCUNKNOWN"}
_PACKS = {0: 1, 1: 1, 2: 2, 4: 4, 8: 8}
"""Packing by the attribute pack_mode: 0 and 1 leave no gaps."""
_SYSTEM = {
    "BITARR8": "BYTE",
    "BITARR16": "WORD",
    "BITARR32": "DWORD",
    "UINTARR2": "UINT[2]",
    "AMSNETID": "USINT[6]",
    "OTCID": "UDINT",
    "FILETIME": "ULINT",
    "DCTIME": "ULINT",
    "HRESULT": "DINT",
    "GUID": "BLOCK(16)",
    "CLSID": "BLOCK(16)",
    "IID": "BLOCK(16)",
}
"""Types of the TwinCAT system as those that they consist of."""
_STRING = re.compile(r"\b(W?)STRING\b(?:\s*[(\[]\s*(\d{1,6})\s*[)\]])?", re.IGNORECASE | re.ASCII)
_DEFAULT_LENGTH = 80
_CONSTANT_RANGE = re.compile(r"^(\w+)\s*\((?!\s*-?\d+\s*\.\.\s*-?\d+\s*\)).*\)$", re.ASCII)


def type_text(text: str, bounds: Iterable[ArrayBound] = ()) -> str:
    """Return TwinCAT's text of a type in the terms of this project.

    A ``STRING(80)`` of TwinCAT has a NUL more than its length says.  The bounds of a subrange may
    be constants, which no file tells: then it is its base type.
    """
    if "STRING" not in text.upper():
        text = _CONSTANT_RANGE.sub(r"\1", text.strip())
    text = _STRING.sub(_sized_string, text)
    text = _SYSTEM.get(text.upper(), text)
    shape = ",".join(f"{each.first}..{each.first + each.count - 1}" for each in bounds)
    return f"{text}[{shape}]" if shape else text


def _sized_string(match: re.Match[str]) -> str:
    length = int(match[2] or _DEFAULT_LENGTH)
    return f"WSTRING({length})" if match[1] else f"STRING({length + 1})"
