"""Object dictionaries of device descriptions."""

from __future__ import annotations

import pytest

from devicebus.esi.fields import Fields
from devicebus.esi.objects import read_objects, type_of
from eap.codec.xmlstream import read_tree
from eap.od.model import RO, RW, RW_PREOP, WO

DICTIONARY_XML = """
<Device><Profile><Dictionary>
  <DataTypes>
    <DataType><Name>DT8000</Name><BitSize>88</BitSize>
      <SubItem><SubIdx>0</SubIdx><Name>SubIndex 000</Name><Type>USINT</Type>
        <BitSize>8</BitSize></SubItem>
      <SubItem><SubIdx>1</SubIdx><Name>Filter</Name><Type>DT0800EN16</Type><BitSize>16</BitSize>
        <Flags><Access WriteRestrictions="PreOP">rw</Access></Flags></SubItem>
      <SubItem><SubIdx>17</SubIdx><Name>Scale</Name><Type>REAL</Type><BitSize>32</BitSize>
        <Flags><Access>ro</Access></Flags></SubItem>
      <SubItem><SubIdx>18</SubIdx><Name>Flags</Name><Type>BITARR4</Type><BitSize>4</BitSize></SubItem>
    </DataType>
    <DataType><Name>DT0800EN16</Name><BaseType>UINT</BaseType><BitSize>16</BitSize></DataType>
    <DataType><Name>DT8010ARR</Name><BaseType>INT</BaseType><BitSize>48</BitSize>
      <ArrayInfo><LBound>1</LBound><Elements>3</Elements></ArrayInfo></DataType>
    <DataType><Name>DT8010</Name><BitSize>64</BitSize>
      <SubItem><SubIdx>0</SubIdx><Name>SubIndex 000</Name><Type>USINT</Type>
        <BitSize>8</BitSize></SubItem>
      <SubItem><Name>Elements</Name><Type>DT8010ARR</Type><BitSize>48</BitSize>
        <Flags><Access>ro</Access></Flags></SubItem>
    </DataType>
    <DataType><Name>DT8011</Name><BitSize>64</BitSize>
      <SubItem><Name>Elements</Name><Type>DTmissing</Type><BitSize>48</BitSize></SubItem></DataType>
  </DataTypes>
  <Objects>
    <Object><Index>#x1018</Index><Name>Identity</Name><Type>DT1018</Type><BitSize>144</BitSize></Object>
    <Object><Index>#x8000</Index><Name>Settings</Name><Type>DT8000</Type><BitSize>88</BitSize>
      <Info>
        <SubItem><Name>Filter</Name><Info><DefaultData>3412</DefaultData></Info></SubItem>
        <SubItem><Name>Scale</Name><Info><DefaultData>0000803f</DefaultData></Info></SubItem>
        <SubItem><Name>Flags</Name><Info><DefaultValue>99</DefaultValue></Info></SubItem>
      </Info></Object>
    <Object><Index>#x8010</Index><Name>Table</Name><Type>DT8010</Type><BitSize>64</BitSize></Object>
    <Object><Index>#x8012</Index><Name>Text</Name><Type>STRING(4)</Type><BitSize>32</BitSize>
      <Info><DefaultString>abc</DefaultString></Info></Object>
    <Object><Index>#x8013</Index><Name>Count</Name><Type>UDINT</Type><BitSize>32</BitSize>
      <Info><DefaultValue>#x10</DefaultValue></Info><Flags><Access>wo</Access></Flags></Object>
    <Object><Index>#x8014</Index><Name>Mode</Name><Type>DT0800EN16</Type><BitSize>16</BitSize>
      <Info><DefaultData>zz</DefaultData></Info></Object>
    <Object><Index>#x8015</Index><Name>Unknown</Name><Type>DT9999</Type><BitSize>16</BitSize></Object>
  </Objects>
</Dictionary></Profile></Device>
"""


@pytest.fixture(scope="module")
def found():
    return {each.index: each for each in read_objects(read_tree([DICTIONARY_XML]), Fields())}


def test_esi_skips_common_objects_and_unknown_types(found):
    assert sorted(found) == [0x8000, 0x8010, 0x8012, 0x8013, 0x8014]


def test_esi_record_has_its_entries(found):
    assert [
        (each.subindex, each.name, each.type, each.default, each.access)
        for each in found[0x8000].entries
    ] == [
        (1, "Filter", "UINT", b"\x34\x12", RW_PREOP),
        (17, "Scale", "REAL", bytes.fromhex("0000803f"), RO),
        (18, "Flags", "BIT4", None, RW),
    ]


def test_esi_array_has_its_elements(found):
    assert [(each.subindex, each.type, each.access) for each in found[0x8010].entries] == [
        (sub, "INT", RO) for sub in (1, 2, 3)
    ]


def test_esi_variables_have_types_and_defaults(found):
    entries = [found[index].entries[0] for index in (0x8012, 0x8013, 0x8014)]
    assert [(each.type, each.default, each.access) for each in entries] == [
        ("STRING(4)", b"abc\0", RW),
        ("UDINT", bytes.fromhex("10000000"), WO),
        ("UINT", None, RW),
    ]


@pytest.mark.parametrize(
    ("name", "bits", "kind"),
    [("INT", 16, "INT"), ("INT", 32, "UDINT"), ("", 3, "BIT3"), ("DT1", 24, "BLOCK(3)")],
)
def test_esi_type_is_that_of_name_and_bits(name, bits, kind):
    assert type_of(name, bits) == kind


def test_types_that_refer_to_each_other_end():
    xml = """<Device><Profile><Dictionary><DataTypes>
      <DataType><Name>A</Name><BaseType>B</BaseType><BitSize>16</BitSize></DataType>
      <DataType><Name>B</Name><BaseType>A</BaseType><BitSize>16</BitSize></DataType>
    </DataTypes><Objects>
      <Object><Index>#x2000</Index><Name>X</Name><Type>A</Type><BitSize>16</BitSize></Object>
    </Objects></Dictionary></Profile></Device>"""
    (item,) = read_objects(read_tree([xml]), Fields())
    assert item.entries[0].type == "UINT"
