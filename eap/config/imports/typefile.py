"""Data types and symbols of TwinCAT files: TMC, TPY, and the DataTypes of a project.

The records are as the file has them: sizes and offsets in bits, types by name.  Whether sizes agree
is checked where types are built of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec

from eap.codec.xmlstream import XmlElement, XmlError, XmlReader
from eap.config.imports.records import ImportReport

_MAX_BITS = 1 << 40
_MAX_BOUND = (1 << 31) - 1
_MAX_DIMENSIONS = 8
_ENUM = 1 << 64
_TMC_TYPE, _TPY_TYPE = "TcModuleClass/DataTypes/DataType", "PlcProjectInfo/DataTypes/DataType"
TSPROJ_TYPE = "TcSmProject/DataTypes/DataType"
_AREA = "TcModuleClass/Modules/Module/DataAreas/DataArea"
_TPY_SYMBOL, _TPY_ADS = "PlcProjectInfo/Symbols/Symbol", "PlcProjectInfo/RoutingInfo/AdsInfo"
ROOTS = "TcModuleClass", "PlcProjectInfo"
IGNORED = "ImageData", "Format", "Hides", "Method"
_AREAS = {"InputDst": "input", "OutputSrc": "output"}


class TypeKind(StrEnum):
    """Kind of a type in a file."""

    STRUCT = "struct"
    UNION = "union"
    ENUM = "enum"
    ARRAY = "array"
    ALIAS = "alias"


class ArrayBound(msgspec.Struct, frozen=True):
    """One dimension of an array."""

    first: int
    count: int


class MemberRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Member of a struct or union.

    Attributes:
        name: Its name.
        type: Name of its type; of an array that of the element.
        bits: Its size; None if the file has none.
        bit_offset: From the start of the struct.
        bounds: Dimensions of an array.
        is_pointer: Pointer or reference.
        comment: Of the project.
        line: Of the file.
    """

    name: str
    type: str
    bits: int | None = None
    bit_offset: int = 0
    bounds: tuple[ArrayBound, ...] = ()
    is_pointer: bool = False
    comment: str = ""
    line: int = 0


class TypeRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One data type of a file.

    Attributes:
        name: Its name.
        namespace: Library that it comes from; may be empty.
        guid: Its GUID in upper case; may be empty.
        bits: Its size.
        base: Base type of an alias or enum, element of an array.
        bounds: Dimensions of an array.
        members: Those of a struct or union, without static ones.
        values: Names and numbers of an enum.
        extends: Struct whose members come first.
        pack: Value of the attribute ``pack_mode``; None without it.
        is_pointer: Pointer or reference.
        line: Of the file.
    """

    name: str
    namespace: str = ""
    guid: str = ""
    bits: int = 0
    base: str = ""
    bounds: tuple[ArrayBound, ...] = ()
    members: tuple[MemberRecord, ...] = ()
    values: tuple[tuple[str, int], ...] = ()
    extends: str = ""
    pack: int | None = None
    is_pointer: bool = False
    line: int = 0

    @property
    def kind(self) -> TypeKind:
        """Kind of the type, by what the file says of it."""
        if self.values:
            return TypeKind.ENUM
        if self.bounds:
            return TypeKind.ARRAY
        if self.members or self.extends or not self.base:
            # A union has no mark: all of its members begin at 0.
            several = len(self.members) > 1 and not self.extends
            is_union = several and all(not each.bit_offset for each in self.members)
            return TypeKind.UNION if is_union else TypeKind.STRUCT
        return TypeKind.ALIAS


class SymbolRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Variable of a program.

    Attributes:
        name: With its program: ``MAIN.position``.
        type: Name of its type; of an array that of the element.
        bits: Its size.
        area: ``input``, ``output`` or empty for all others.
        bounds: Dimensions of an array.
        comment: Of the project.
        line: Of the file.
    """

    name: str
    type: str
    bits: int = 0
    area: str = ""
    bounds: tuple[ArrayBound, ...] = ()
    comment: str = ""
    line: int = 0


class TypeFile(msgspec.Struct, frozen=True):
    """Types and symbols of one file."""

    types: tuple[TypeRecord, ...]
    symbols: tuple[SymbolRecord, ...] = ()
    net_id: str = ""
    """NetID of the controller, which a TPY file has."""


def read_type_file(chunks: Iterable[bytes], file: str, report: ImportReport) -> TypeFile:
    """Read a TMC or TPY file; everything wrong in it is reported.

    Args:
        chunks: The content of the file.
        file: Its name, for findings.
        report: Takes the findings.
    """
    wanted = (_TMC_TYPE, _TPY_TYPE, _AREA, _TPY_SYMBOL, _TPY_ADS)
    types: list[TypeRecord] = []
    symbols: list[SymbolRecord] = []
    net_id = ""
    try:
        for element in XmlReader(wanted, roots=ROOTS, ignored=IGNORED).read(chunks):
            match element.tag:
                case "DataType":
                    types += read_types([element], file, report)
                case "AdsInfo":
                    net_id = element.findtext("NetId")
                case "DataArea":
                    number = element.find("AreaNo")
                    area = _AREAS.get(number.get("AreaType"), "") if number else ""
                    symbols += _symbols(element.iterfind("Symbol"), area, file, report)
                case "Symbol":
                    symbols += _symbols([element], "", file, report)
    except XmlError as exc:
        report.add_error(file, exc)
    return TypeFile(tuple(types), tuple(symbols), net_id)


def read_types(elements: Iterable[XmlElement], file: str, report: ImportReport) -> list[TypeRecord]:
    """Return the types of the elements ``DataType``; a wrong one is reported and left out."""
    found = []
    for element in elements:
        try:
            found.append(_type(element))
        except XmlError as exc:
            report.add_error(file, exc, item=element.findtext("Name"))
    return found


def _symbols(
    elements: Iterable[XmlElement], area: str, file: str, report: ImportReport
) -> Iterable[SymbolRecord]:
    for element in elements:
        try:
            yield SymbolRecord(
                name=element.findtext("Name"),
                type=_base(element),
                bits=element.number_at("BitSize", 0, _MAX_BITS),
                area=area,
                bounds=_bounds(element),
                comment=_one_line(element.findtext("Comment")),
                line=element.line,
            )
        except XmlError as exc:
            report.add_error(file, exc, item=element.findtext("Name"))


def _type(element: XmlElement) -> TypeRecord:
    name = element.find("Name")
    if name is None or not name.text:
        raise XmlError("a DataType has no Name", line=element.line, expected="the element Name")
    # The same element has two names: BaseType in TMC files, Type in TPY files.
    base = element.find("BaseType") or element.find("Type")
    return TypeRecord(
        name=name.text,
        namespace=name.get("Namespace"),
        guid=name.get("GUID").upper(),
        bits=element.number_at("BitSize", 0, _MAX_BITS),
        base="" if base is None else base.text,
        bounds=_bounds(element),
        members=tuple(
            _member(each)
            for each in element.iterfind("SubItem")
            # Static members are no part of the struct; they have no offset.
            if each.find("BitOffs") is not None
        ),
        values=tuple(
            (each.findtext("Text"), each.number_at("Enum", -_ENUM, _ENUM))
            for each in element.iterfind("EnumInfo")
        ),
        extends=element.findtext("ExtendsType"),
        pack=_pack(element),
        is_pointer=base is not None and _is_pointer(base),
        line=element.line,
    )


def _member(element: XmlElement) -> MemberRecord:
    kind = element.find("Type") or element.find("BaseType")
    if kind is None or not element.findtext("Name"):
        raise XmlError(
            "a SubItem has no Name or no Type", line=element.line, expected="both elements"
        )
    # A few members of real files have none: their type gives the size.
    has_size = element.find("BitSize") is not None
    return MemberRecord(
        name=element.findtext("Name"),
        type=kind.text,
        bits=element.number_at("BitSize", 0, _MAX_BITS) if has_size else None,
        bit_offset=element.number_at("BitOffs", 0, _MAX_BITS),
        bounds=_bounds(element),
        is_pointer=_is_pointer(kind),
        comment=_one_line(element.findtext("Comment")),
        line=element.line,
    )


def _base(element: XmlElement) -> str:
    return element.findtext("BaseType") or element.findtext("Type")


def _bounds(element: XmlElement) -> tuple[ArrayBound, ...]:
    found = tuple(
        ArrayBound(
            each.number_at("LBound", -_MAX_BOUND, _MAX_BOUND),
            each.number_at("Elements", 0, _MAX_BOUND),
        )
        for each in element.iterfind("ArrayInfo")
    )
    if len(found) > _MAX_DIMENSIONS:
        raise XmlError(
            f"an array has {len(found)} dimensions",
            line=element.line,
            expected=f"at most {_MAX_DIMENSIONS}",
        )
    return found


def _is_pointer(kind: XmlElement) -> bool:
    # Noted to be refused: an address means nothing to another controller.
    return bool(kind.get("PointerTo") or kind.get("ReferenceTo"))


def _pack(element: XmlElement) -> int | None:
    for each in element.iterfind("Properties/Property"):
        if each.findtext("Name").lower() == "pack_mode":
            return each.number_at("Value", 0, 8)
    return None


def _one_line(text: str) -> str:
    return " ".join(text.split())
