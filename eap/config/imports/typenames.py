"""Types of imported variables: found in the files, checked, and written as a section of types."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from eap.codec.arrays import Array
from eap.codec.enumerations import Enumeration
from eap.codec.structures import Structure, lay_out_structure
from eap.config.finding import FindingReport
from eap.config.imports.planttext import scalar
from eap.config.imports.records import EapVariable, ImportOutcome, ImportReport
from eap.config.imports.typefile import ArrayBound, SymbolRecord, TypeRecord
from eap.config.types import ReportedTypeError, TypeTable, definition_of, type_text

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType

# TwinCAT's BOOL has a byte, that of ETG.1005 one bit.  A BIT has a byte, too: only in structs of
# the system is it one bit.
_BIT_TYPES = {"BIT": "BOOL8", "BOOL": "BOOL8"}
_WIDTH = 100


class TypeNames:
    """Types of the variables of one controller.

    Args:
        sources: Types of its files, with the name of each file.
        report: Takes the findings.
    """

    def __init__(
        self, sources: Iterable[tuple[str, Sequence[TypeRecord]]], report: ImportReport
    ) -> None:
        self._findings = FindingReport("")
        definitions, self._by_guid = [], {}
        for file, records in sources:
            for each in records:
                definitions.append(definition_of(each, file))
                if each.guid:
                    self._by_guid[each.guid] = each.name
        self._table = TypeTable(definitions, self._findings)
        self._report = report
        self._used: dict[str, DataType] = {}

    def text_of(self, variable: EapVariable, file: str) -> str:
        """Return the type of a network variable, as a plant file names it.

        A type that no file has is a block of bytes, with a warning.

        Raises:
            ValueError: its type is invalid, or its size is not that of the variable.
        """
        if not variable.type and not variable.bits:
            raise ValueError(f"{variable.name} has neither a type nor a length")
        if variable.bits % 8:
            raise ValueError(f"{variable.name} has {variable.bits} bits, no whole bytes")
        try:
            kind = self.parse(variable.type, variable.guid)
        except ReportedTypeError:
            text = f"{variable.name}: its type {variable.type} cannot be used"
            raise ValueError(text) from None
        except ValueError:
            if not variable.bits:
                raise
            block = f"BLOCK({variable.bits // 8})"
            name = variable.type or "without a name"
            message = (
                f"type {name} is in none of the files: {block} is taken; import its TMC file too"
            )
            item = variable.name
            self._report.note(file, variable.line, item, ImportOutcome.WARNING, message)
            return block
        if variable.bits and kind.size * 8 != variable.bits:
            layout = "".join(f"\n{line}" for line in layout_lines(kind))
            raise ValueError(
                f"{variable.name} has {variable.bits // 8} bytes, its type {kind.name} has"
                f" {kind.size}{layout}"
            )
        return kind.name

    def parse(self, text: str, guid: str = "", bounds: Sequence[ArrayBound] = ()) -> DataType:
        """Return a type by its name in TwinCAT; raise ValueError if it cannot be used."""
        name = self._by_guid.get(guid, "") or text
        ours = type_text(name, bounds)
        kind = self._table.parse(_BIT_TYPES.get(ours.upper(), ours))
        self._use(kind)
        return kind

    def parse_if_usable(self, symbol: SymbolRecord) -> DataType | str:
        """Return the type of a symbol, or the reason that it cannot be used."""
        before = self._findings.findings()
        try:
            kind = self.parse(symbol.type, bounds=symbol.bounds)
        except ReportedTypeError:
            new = (each for each in self._findings.findings() if each not in before)
            first = next(new, None)  # none if it was reported with another symbol
            if first is None:
                return f"its type {symbol.type} cannot be used"
            return f"{first.message}; expected {first.expected}"
        except ValueError as exc:
            return str(exc)
        if symbol.bits not in {0, 8 * kind.size}:
            return f"it has {symbol.bits} bits, its type {kind.name} has {8 * kind.size}"
        return kind

    def take_findings(self) -> None:
        """Report the errors of the types that are used."""
        # They are the cause of the others.
        self._report.findings[:0] = self._findings.findings()

    def section(self) -> list[str]:
        """Return the lines of the section ``types``: all types in use, empty if there are none."""
        if not self._used:
            return []
        return ["types:", *(f"  {line}" for kind in self._used.values() for line in _lines(kind))]

    def _use(self, kind: DataType) -> None:
        """Note all definitions in *kind*, those that others need first."""
        if kind.alias_of is not None:
            self._use(kind.alias_of)
            self._used[kind.name] = kind
        elif isinstance(kind, Array):
            self._use(kind.element)
        elif isinstance(kind, Structure):
            for member in kind.members:
                self._use(member.kind)
            self._used[kind.name] = kind
        elif isinstance(kind, Enumeration):
            self._used[kind.name] = kind


def layout_lines(kind: DataType) -> Iterator[str]:
    """Yield the offsets and sizes of the members of *kind*."""
    if isinstance(kind, Structure):
        for name, member, bit_offset in kind.members:
            yield f"  {name:24} at {bit_offset / 8:g} size {member.bit_length / 8:g}  {member.name}"


def _lines(kind: DataType) -> Iterator[str]:
    if kind.alias_of is not None:
        yield f"{kind.name}: {scalar(kind.alias_of.name)}"
    elif isinstance(kind, Enumeration):
        values = [f"{name}: {number}" for name, number in kind.numbers.items()]
        yield from _folded(f"{kind.name}: {{base: {kind.base}, values: {{", values, "}}")
    elif isinstance(kind, Structure):
        form = "union" if kind.is_union else "members"
        is_usual = _is_usual(kind)
        end = f"}}, size: {kind.size}}}" if not is_usual else "}}"
        members = [
            f"{name}: {scalar(member.name)}"
            if is_usual
            else f"{name}: {{type: {scalar(member.name)}, {_place(member, bit_offset)}}}"
            for name, member, bit_offset in kind.members
        ]
        yield from _folded(f"{kind.name}: {{{form}: {{", members, end)


def _is_usual(kind: Structure) -> bool:
    """Return whether a compiler lays *kind* out alike, so that no offsets need be written."""
    members = [(name, member) for name, member, _ in kind.members]
    try:
        computed = lay_out_structure(kind.name, members, union=kind.is_union)
    except ValueError:
        return False
    return computed == kind


def _place(member: DataType, bit_offset: int) -> str:
    offset, bit = divmod(bit_offset, 8)
    return f"offset: {offset}, bit: {bit}" if member.is_bits else f"offset: {offset}"


def _folded(start: str, parts: Sequence[str], end: str) -> Iterator[str]:
    """Yield a mapping in braces, on several lines where it is long."""
    whole = f"{start}{', '.join(parts)}{end}"
    if len(whole) + 2 <= _WIDTH:
        yield whole
        return
    yield start
    for number, part in enumerate(parts, 1):
        yield f"  {part}{',' if number < len(parts) else end}"
