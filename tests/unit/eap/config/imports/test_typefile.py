from __future__ import annotations

from eap.config.imports.records import ImportReport
from eap.config.imports.typefile import (
    ArrayBound,
    MemberRecord,
    TypeFile,
    TypeKind,
    TypeRecord,
    read_type_file,
)

# The elements, attributes and their order are those of the TMC files that TwinCAT 3 writes.
TMC = """\
<?xml version="1.0" encoding="UTF-8"?>
<TcModuleClass><DataTypes>
<DataType><Name GUID="{11111111-0000-4000-8000-00000000000a}" Namespace="Lib">ST_A</Name><BitSize>128</BitSize>
<SubItem><Name>b</Name><Type GUID="{18071995-0000-0000-0000-000000000001}">BYTE</Type><Comment><![CDATA[ a
 byte ]]></Comment><BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem>
<SubItem><Name>shared</Name><Type>UINT</Type><BitSize>16</BitSize></SubItem>
<SubItem><Name>r</Name><Type>LREAL</Type><BitSize>64</BitSize><BitOffs>64</BitOffs></SubItem>
<Properties><Property><Name>pack_mode</Name><Value>8</Value></Property></Properties></DataType>
<DataType><Name>E_M</Name><BitSize>16</BitSize><BaseType>INT</BaseType>
<EnumInfo><Text>Off</Text><Enum>0</Enum></EnumInfo><EnumInfo><Text>On</Text><Enum>-5</Enum></EnumInfo></DataType>
<DataType><Name>ARRAY [1..3] OF ST_A</Name><BitSize>384</BitSize><BaseType>ST_A</BaseType>
<ArrayInfo><LBound>1</LBound><Elements>3</Elements></ArrayInfo></DataType>
<DataType><Name>U_X</Name><BitSize>32</BitSize>
<SubItem><Name>d</Name><Type>DWORD</Type><BitSize>32</BitSize><BitOffs>0</BitOffs></SubItem>
<SubItem><Name>w</Name><Type>WORD</Type><ArrayInfo><LBound>0</LBound><Elements>2</Elements></ArrayInfo>
<BitSize>32</BitSize><BitOffs>0</BitOffs></SubItem></DataType>
<DataType><Name>T_Name</Name><BitSize>2048</BitSize><BaseType>STRING(255)</BaseType></DataType>
<DataType><Name>ST_B</Name><BitSize X64="256">192</BitSize><ExtendsType>ST_A</ExtendsType>
<SubItem><Name>p</Name><Type PointerTo="1">INT</Type><BitSize>32</BitSize><BitOffs>128</BitOffs></SubItem></DataType>
</DataTypes>
<Modules><Module><DataAreas><DataArea><AreaNo AreaType="OutputSrc">1</AreaNo><Name>Task Outputs</Name>
<Symbol><Name>MAIN.a</Name><Comment>axis</Comment><BitSize>128</BitSize><BaseType>ST_A</BaseType><BitOffs>8</BitOffs></Symbol>
</DataArea></DataAreas></Module></Modules></TcModuleClass>
"""  # noqa: E501
TPY = """\
<PlcProjectInfo><RoutingInfo><AdsInfo><NetId>5.1.2.3.1.1</NetId><Port>851</Port></AdsInfo></RoutingInfo>
<DataTypes><DataType><Name Decoration="1">ST_V</Name><BitSize>32</BitSize><SubItem><Name>major</Name>
<Type>UINT</Type><BitSize>16</BitSize><BitOffs>0</BitOffs></SubItem><SubItem><Name>minor</Name><Type>UINT</Type>
<BitSize>16</BitSize><BitOffs>16</BitOffs></SubItem></DataType>
<DataType><Name>OTCID</Name><Type>UDINT</Type><BitSize>32</BitSize></DataType></DataTypes>
<Symbols><Symbol><Name>MAIN.v</Name><Type Decoration="1">ST_V</Type><IGroup>16448</IGroup><IOffset>4</IOffset>
<BitSize>32</BitSize></Symbol></Symbols></PlcProjectInfo>
"""  # noqa: E501


def read(text: str) -> tuple[TypeFile, list[str]]:
    report = ImportReport()
    found = read_type_file([text.encode()], "axis.tmc", report)
    assert not report.notes
    return found, [str(each) for each in report.findings]


def test_tmc_types_are_read_with_sizes_and_offsets() -> None:
    found, findings = read(TMC)
    assert not findings
    struct, enum, array, union, alias, extended = found.types
    assert [each.kind for each in found.types] == [
        TypeKind.STRUCT, TypeKind.ENUM, TypeKind.ARRAY, TypeKind.UNION, TypeKind.ALIAS,
        TypeKind.STRUCT,
    ]  # fmt: skip
    assert (struct.name, struct.namespace, struct.bits, struct.pack) == ("ST_A", "Lib", 128, 8)
    assert struct.guid == "{11111111-0000-4000-8000-00000000000A}"
    # The static member is no part of the struct.
    assert struct.members == (
        MemberRecord(name="b", type="BYTE", bits=8, comment="a byte", line=4),
        MemberRecord(name="r", type="LREAL", bits=64, bit_offset=64, line=7),
    )
    assert (enum.base, enum.values) == ("INT", (("Off", 0), ("On", -5)))
    assert (array.base, array.bounds) == ("ST_A", (ArrayBound(1, 3),))
    assert union.members[1].bounds == (ArrayBound(0, 2),)
    assert (alias.base, alias.bits) == ("STRING(255)", 2048)
    assert (extended.extends, extended.members[0].is_pointer) == ("ST_A", True)
    (symbol,) = found.symbols
    assert (symbol.name, symbol.type, symbol.bits, symbol.area) == ("MAIN.a", "ST_A", 128, "output")


def test_tpy_types_and_symbols_are_read_with_the_net_id() -> None:
    found, findings = read(TPY)
    assert not findings
    assert [each.name for each in found.types] == ["ST_V", "OTCID"]
    assert found.types[1] == TypeRecord(name="OTCID", base="UDINT", bits=32, line=5)
    assert found.net_id == "5.1.2.3.1.1"
    assert [(each.name, each.type, each.bits) for each in found.symbols] == [("MAIN.v", "ST_V", 32)]


def test_every_wrong_type_is_reported_with_its_line_and_left_out() -> None:
    text = TMC.replace("<BitOffs>64<", "<BitOffs>x<").replace("<Enum>0<", "<Enum>1e9<")
    text = text.replace("<Name>T_Name</Name>", "")
    found, findings = read(text)
    assert findings == [
        "axis.tmc:7: BitOffs is 'x'; expected a whole number from 0 to 1099511627776",
        f"axis.tmc:10: Enum is '1e9'; expected a whole number from {-(1 << 64)} to {1 << 64}",
        "axis.tmc:17: a DataType has no Name; expected the element Name",
    ]
    assert [each.name for each in found.types] == ["ARRAY [1..3] OF ST_A", "U_X", "ST_B"]


def test_truncated_file_is_refused() -> None:
    _, (finding,) = read(TMC[: TMC.index("<Modules>")])
    assert finding.startswith("axis.tmc:21: not XML that can be read: no element found")


def test_file_with_another_root_is_refused() -> None:
    _, findings = read("<Other/>")
    assert findings == [
        "axis.tmc:1: it begins with 'Other'; expected TcModuleClass or PlcProjectInfo"
    ]


def test_array_with_too_many_dimensions_is_refused() -> None:
    bounds = "<ArrayInfo><LBound>0</LBound><Elements>2</Elements></ArrayInfo>" * 9
    text = TMC.replace("<ArrayInfo><LBound>1</LBound><Elements>3</Elements></ArrayInfo>", bounds)
    _, findings = read(text)
    assert findings == ["axis.tmc:11: an array has 9 dimensions; expected at most 8"]
