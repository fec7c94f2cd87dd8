"""Simulated devices from ESI files."""

from __future__ import annotations

import io

import pytest

from devicebus.esi.choice import plan_device
from devicebus.esi.content import list_devices, load_device
from devicebus.sim.devices.build import build_slave
from devicebus.sim.devices.esi import complete
from devicebus.sim.spec import ChannelSpec, DeviceKind, SlaveSpec
from devicebus.wire import sii
from tests.support.terminals import esi

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
      <Sm StartAddress="#x1200" ControlByte="#x64" Enable="1">Outputs</Sm>
      <Sm StartAddress="#x1400" ControlByte="#x20" Enable="1">Inputs</Sm>
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
SPEC = SlaveSpec(name="mixed", kind=DeviceKind.ESI)


def device_of(xml, number=1):
    listed = list_devices(io.BytesIO(xml)).devices[number]
    return load_device(io.BytesIO(xml), listed).device


def completed(xml, number=1, spec=SPEC):
    return complete(spec, plan_device(device_of(xml, number)))


def test_esi_device_equals_its_file():
    spec = completed(XML)
    assert (spec.vendor, spec.product, spec.revision) == (0x123, 2, 0x20000)
    assert (spec.mailbox.size, spec.mailbox.foe, spec.mailbox.soe) == (192, True, False)
    assert [(c.name, c.type, c.bits, c.object, c.pdo) for c in spec.outputs] == [
        ("Out.Nibble", "BIT4", 4, "0x7000:01", 0x1600),
        ("Not_assigned.7010_01", "USINT", 8, "0x7010:01", 0x1601),
    ]
    assert [(c.name, c.type) for c in spec.inputs] == [("In.Level", "INT"), ("In.Odd", "BLOCK(3)")]


@pytest.mark.parametrize(
    ("bits", "expected"), [(3, [3]), (12, [12]), (28, [28]), (255, [255]), (300, [255, 45])]
)
def test_esi_padding_is_one_entry_as_far_as_a_mapping_can_say(bits, expected):
    xml = XML.replace(
        b"<Index>0</Index><BitLen>4</BitLen>", b"<Index>#x0</Index><BitLen>%d</BitLen>" % bits
    )
    slave = build_slave(SPEC, {}, device_of(xml))
    pdo = sii.decode(slave.esc.image).rx_pdos[0]
    assert [each.bit_length for each in pdo.entries] == [4, *expected]
    assert slave.device.process_data.outputs.size == (4 + bits + 7) // 8


@pytest.mark.parametrize(
    ("bits", "kind"), [(3, "BIT3"), (12, "UINT"), (24, "BLOCK(3)"), (69, "BLOCK(9)")]
)
def test_esi_entry_of_odd_length_keeps_its_bits(bits, kind):
    xml = XML.replace(b"<BitLen>24</BitLen>", b"<BitLen>%d</BitLen>" % bits)
    assert completed(xml).inputs[1].type == kind
    slave = build_slave(SPEC, {}, device_of(xml))
    assert [entry.bit_length for entry in sii.decode(slave.esc.image).tx_pdos[0].entries] == [
        16,
        bits,
    ]
    slave.device.process_data.inputs.entries[1].entry.octets = bytes((0xFF,)) * 9
    assert slave.device.process_data.inputs.pack() == ((1 << bits) - 1 << 16).to_bytes(
        (16 + bits + 7) // 8, "little"
    )


@pytest.mark.parametrize(("number", "outputs", "inputs"), [(0, 0, 1), (1, 1, 0), (2, 0, 1)])
def test_esi_pdos_of_one_bit_share_a_byte(number, outputs, inputs):
    slave = build_slave(SPEC, {}, device_of(esi().encode(), number))
    data = slave.device.process_data
    assert (data.outputs.size, data.inputs.size) == (outputs, inputs)
    read = sii.decode(slave.esc.image)
    assert {e.bit_length for pdo in (*read.rx_pdos, *read.tx_pdos) for e in pdo.entries} == {1}


def test_esi_slave_has_the_layout_of_its_file():
    slave = build_slave(SPEC, {}, device_of(XML))
    image = sii.decode(slave.esc.image)
    fixed = image.fixed
    assert (fixed.vendor, fixed.receive_size, fixed.send_size) == (0x123, 192, 160)
    assert (fixed.receive_offset, fixed.send_offset) == (0x1000, 0x10C0)
    assert [(each.start, each.length, each.control) for each in image.sync_managers] == [
        (0x1000, 192, 0x26),
        (0x10C0, 160, 0x22),
        (0x1200, 1, 0x64),
        (0x1400, 5, 0x20),
    ]
    assert slave.device.process_data.inputs.size == 5
    assert slave.device.process_data.outputs.size == 1
    assert [pdo.header.sync_manager for pdo in image.rx_pdos] == [2, 0xFF]
    assert [image.string(pdo.header.name) for pdo in image.rx_pdos] == ["Out", "Not assigned"]
    assert [entry.bit_length for entry in image.rx_pdos[0].entries] == [4, 4]
    assert slave.device.dictionary[0x8001].name == "Gain"
    assert sii.is_intact(slave.esc.image)


def test_input_of_the_bus_file_adds_a_source():
    given = SlaveSpec(
        name="x", kind=DeviceKind.ESI, inputs=(ChannelSpec(name="In.Level", values=(7,)),)
    )
    slave = build_slave(given, {}, device_of(XML))
    slave.device.step(0)
    assert slave.device.dictionary.entry(0x6000, 1).value == 7
    assert slave.device.channels["In.Level"] == (0x6000, 1)


def test_input_that_the_file_does_not_have_is_refused():
    given = SlaveSpec(name="x", kind=DeviceKind.ESI, inputs=(ChannelSpec(name="In.Levle"),))
    with pytest.raises(ValueError, match=r"no process data 'In\.Levle', did you mean In\.Level"):
        build_slave(given, {}, device_of(XML))
