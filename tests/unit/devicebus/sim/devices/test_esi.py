"""Devices from ESI files."""

from __future__ import annotations

import pytest
from defusedxml import ElementTree

from devicebus.sim.devices.build import build_slave
from devicebus.sim.devices.esi import complete, number, objects, type_of
from devicebus.sim.spec import AccessKind, DeviceKind, SlaveSpec
from devicebus.wire import sii
from tests.support.terminals import DI4, DI8, DO8, esi

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
    return {each.index: each for each in objects(ElementTree.fromstring(DICTIONARY_XML))}


def test_esi_skips_common_objects_and_unknown_types(found):
    assert sorted(found) == [0x8000, 0x8010, 0x8012, 0x8013, 0x8014]


def test_record(found):
    assert [
        (each.subindex, each.name, each.type, each.value, each.access)
        for each in found[0x8000].entries
    ] == [
        (1, "Filter", "UINT", 0x1234, AccessKind.CONFIGURATION),
        (17, "Scale", "REAL", 1.0, AccessKind.READ),
        (18, "Flags", "BIT4", None, AccessKind.READ_WRITE),
    ]


def test_array(found):
    assert [(each.subindex, each.type, each.access) for each in found[0x8010].entries] == [
        (sub, "INT", AccessKind.READ) for sub in (1, 2, 3)
    ]


def test_variables(found):
    assert [(found[i].type, found[i].value, found[i].access) for i in (0x8012, 0x8013, 0x8014)] == [
        ("STRING(4)", "abc", AccessKind.READ_WRITE),
        ("UDINT", 16, AccessKind.WRITE),
        ("UINT", None, AccessKind.READ_WRITE),
    ]


@pytest.mark.parametrize(("text", "value"), [("#x1A00", 0x1A00), (" 12 ", 12), ("#X0f", 15)])
def test_numbers(text, value):
    assert number(text) == value


@pytest.mark.parametrize(
    ("name", "bits", "kind"),
    [("INT", 16, "INT"), ("INT", 32, "UDINT"), ("", 3, "BIT3"), ("DT1", 24, "BLOCK(3)")],
)
def test_types(name, bits, kind):
    assert type_of(name, bits) == kind


XML = b"""<?xml version="1.0"?>
<EtherCATInfo>
  <Vendor><Id>#x00000123</Id><Name>Somebody</Name></Vendor>
  <Descriptions><Devices>
    <Device Physics="YY">
      <Type ProductCode="#x1" RevisionNo="#x10000">Other</Type>
    </Device>
    <Device Physics="YY">
      <Type ProductCode="#x2" RevisionNo="#x20000">Mixed</Type>
      <Sm DefaultSize="192" StartAddress="#x1000" ControlByte="#x26" Enable="1">MBoxOut</Sm>
      <Sm DefaultSize="160" StartAddress="#x10c0" ControlByte="#x22" Enable="1">MBoxIn</Sm>
      <Mailbox DataLinkLayer="1"><CoE SdoInfo="1"/><FoE/></Mailbox>
      <RxPdo Fixed="1" Sm="2"><Index>#x1600</Index><Name>Out</Name>
        <Entry><Index>#x7000</Index><SubIndex>1</SubIndex><BitLen>4</BitLen>
          <Name>Nibble</Name><DataType>BITARR4</DataType></Entry>
        <Entry><Index>0</Index><BitLen>4</BitLen></Entry>
      </RxPdo>
      <RxPdo><Index>#x1601</Index><Name>Not assigned</Name>
        <Entry><Index>#x7010</Index><SubIndex>1</SubIndex><BitLen>8</BitLen></Entry>
      </RxPdo>
      <TxPdo Fixed="1" Sm="3"><Index>#x1A00</Index><Name>In</Name>
        <Entry><Index>#x6000</Index><SubIndex>1</SubIndex><BitLen>16</BitLen>
          <Name>Level</Name><DataType>INT</DataType></Entry>
        <Entry><Index>#x6000</Index><SubIndex>2</SubIndex><BitLen>24</BitLen>
          <Name>Odd</Name><DataType>WHATEVER</DataType></Entry>
      </TxPdo>
      <Profile><Dictionary><Objects>
        <Object><Index>#x1018</Index><Name>Identity</Name><Type>DT1018</Type>
          <BitSize>144</BitSize></Object>
        <Object><Index>#x8001</Index><Name>Gain</Name><Type>UINT</Type><BitSize>16</BitSize>
          <Flags><Access>ro</Access></Flags></Object>
        <Object><Index>#x8002</Index><Name>Group</Name><Type>DT8002</Type>
          <BitSize>40</BitSize></Object>
      </Objects></Dictionary></Profile>
    </Device>
  </Devices></Descriptions>
</EtherCATInfo>
"""
SPEC = SlaveSpec(name="mixed", kind=DeviceKind.ESI, esi="mixed.xml", product=2)


def test_esi_device_equals_its_file():
    spec = complete(SPEC, XML)
    assert (spec.vendor, spec.product, spec.revision) == (0x123, 2, 0x20000)
    assert (spec.mailbox.size, spec.mailbox.foe, spec.mailbox.soe) == (160, True, False)
    assert [(c.name, c.type, c.bits, c.object, c.pdo, c.assigned) for c in spec.outputs] == [
        ("Nibble", "BIT4", 4, "0x7000:1", 0x1600, True),
        ("", "BOOL", 4, "0", 0x1600, True),
        ("0x7010:1", "USINT", 8, "0x7010:1", 0x1601, False),
    ]
    assert [(c.name, c.type) for c in spec.inputs] == [("Level", "INT"), ("Odd", "BLOCK(3)")]
    assert [(o.index, o.name, o.type) for o in spec.objects] == [(0x8001, "Gain", "UINT")]


@pytest.mark.parametrize(
    ("bits", "expected"), [(3, [3]), (12, [12]), (28, [28]), (255, [255]), (300, [255, 45])]
)
def test_esi_padding_is_one_entry_as_far_as_a_mapping_can_say(bits, expected):
    xml = XML.replace(
        b"<Index>0</Index><BitLen>4</BitLen>", b"<Index>#x0</Index><BitLen>%d</BitLen>" % bits
    )
    assert [c.bits for c in complete(SPEC, xml).outputs[1:-1]] == expected
    slave = build_slave(SPEC, {"mixed.xml": xml})
    assert slave.device.process_data.outputs.size == (4 + bits + 7) // 8


@pytest.mark.parametrize(
    ("bits", "kind"), [(3, "BIT3"), (12, "UINT"), (24, "BLOCK(3)"), (69, "BLOCK(9)")]
)
def test_esi_entry_of_odd_length_keeps_its_bits(bits, kind):
    xml = XML.replace(b"<BitLen>24</BitLen>", b"<BitLen>%d</BitLen>" % bits)
    assert complete(SPEC, xml).inputs[1].type == kind
    slave = build_slave(SPEC, {"mixed.xml": xml})
    assert [entry.bit_length for entry in sii.decode(slave.esc.image).tx_pdos[0].entries] == [
        16,
        bits,
    ]
    slave.device.process_data.inputs.entries[1].entry.octets = bytes((0xFF,)) * 9
    assert slave.device.process_data.inputs.pack() == ((1 << bits) - 1 << 16).to_bytes(
        (16 + bits + 7) // 8, "little"
    )


@pytest.mark.parametrize(("product", "outputs", "inputs"), [(DI8, 0, 1), (DO8, 1, 0), (DI4, 0, 1)])
def test_esi_pdos_of_one_bit_share_a_byte(product, outputs, inputs):
    spec = SlaveSpec(name="x", kind=DeviceKind.ESI, esi="terminals.xml", product=product)
    slave = build_slave(spec, {"terminals.xml": esi().encode()})
    data = slave.device.process_data
    assert (data.outputs.size, data.inputs.size) == (outputs, inputs)
    read = sii.decode(slave.esc.image)
    assert {e.bit_length for pdo in (*read.rx_pdos, *read.tx_pdos) for e in pdo.entries} == {1}


def test_first_device_without_a_product_code():
    spec = complete(SlaveSpec(name="x", kind=DeviceKind.ESI, esi="mixed.xml"), XML)
    assert (spec.product, spec.mailbox, spec.inputs) == (1, None, ())


def test_esi_slave_is_built():
    slave = build_slave(SPEC, {"mixed.xml": XML})
    image = sii.decode(slave.esc.image)
    assert (image.fixed.vendor, image.fixed.receive_size) == (0x123, 160)
    assert slave.device.process_data.inputs.size == 5
    assert slave.device.process_data.outputs.size == 1
    assert [pdo.header.sync_manager for pdo in image.rx_pdos] == [2, 0xFF]
    assert [entry.bit_length for entry in image.rx_pdos[0].entries] == [4, 4]
    assert slave.device.dictionary[0x8001].name == "Gain"


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (b"<a", "not XML that can be read"),
        (b"<a/>", "begins with a, expected EtherCATInfo"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "not XML that can be read"),
        (b"<EtherCATInfo/>", "describes 0 devices, none with product code 0x2"),
    ],
)
def test_file_that_cannot_be_used(xml, message):
    with pytest.raises(ValueError, match=message):
        complete(SPEC, xml)
