"""ESI files: lists of their devices, and devices in full."""

from __future__ import annotations

import io

import pytest

from devicebus.esi.content import list_devices, load_device
from devicebus.esi.records import EsiSyncManager, SmUse
from eap.od.slave_config import OpMode, RevisionRule

HEAD = (
    '<?xml version="1.0"?><EtherCATInfo><Vendor><Id>#x2</Id><Name>V</Name></Vendor><Descriptions>'
)
DRIVE = """
<Device Physics="YY"><Type ProductCode="#x1B" RevisionNo="#x00120000"
   CheckRevisionNo="LW_EQ_HW_EQ_OR_G">AX1</Type><HideType RevisionNo="#x00110000"/>
  <Name LcId="1031">Antrieb</Name><Name LcId="1033">Drive</Name>
  <Info><StateMachine><Timeout><PreopTimeout>3000<!-- I->P --></PreopTimeout>
    <SafeopOpTimeout> 10000
    </SafeopOpTimeout></Timeout></StateMachine><Electrical><EBusCurrent>-250</EBusCurrent>
    </Electrical></Info>
  <GroupType>Drives</GroupType>
  <Fmmu>Outputs</Fmmu><Fmmu Sm="3">Inputs</Fmmu>
  <Sm MinSize="64" MaxSize="256" DefaultSize="128" StartAddress="#x1000" ControlByte="#x26"
    Enable="1">MBoxOut</Sm>
  <Sm DefaultSize="128" StartAddress="#x1080" ControlByte="#x22" Enable="true">MBoxIn</Sm>
  <Sm StartAddress="#x1100" ControlByte="#x64" Enable="1" OpOnly="1">Outputs</Sm>
  <Sm StartAddress="#x1
     180" ControlByte="#x20">Inputs</Sm>
  <RxPdo Mandatory="1" Sm="2"><Index>#x1600</Index><Name>Drive Outputs</Name>
    <Exclude>#x1601</Exclude>
    <Entry><Index>#x6040</Index><SubIndex>0</SubIndex><BitLen>16</BitLen><Name>Controlword</Name>
      <DataType>UINT</DataType></Entry>
    <Entry><Index>0</Index><BitLen>8</BitLen></Entry></RxPdo>
  <RxPdo Fixed="true"><Index>#x1601</Index><Name>Other</Name></RxPdo>
  <Mailbox DataLinkLayer="1"><CoE SdoInfo="1" PdoAssign="1" PdoConfig="0" CompleteAccess="1">
    <InitCmd><Transition>PS</Transition><Index>#x6060</Index><SubIndex>0</SubIndex><Data>08</Data>
      <Comment>Op mode</Comment></InitCmd></CoE><FoE/></Mailbox>
  <Dc><OpMode><Name>DC</Name><AssignActivate>#x0730</AssignActivate>
    <CycleTimeSync0 Factor="1">0</CycleTimeSync0><ShiftTimeSync0>125</ShiftTimeSync0>
    <CycleTimeSync1 Factor="-2">0</CycleTimeSync1></OpMode></Dc>
  <Eeprom><ByteSize>2048</ByteSize><ConfigData>080C0088C409 0100</ConfigData>
    <BootStrap>0010140200181402</BootStrap></Eeprom>
  <ImageData16x14>424D</ImageData16x14>
</Device>"""


def esi(*devices, modules="", tail="</Descriptions></EtherCATInfo>"):
    return (f"{HEAD}<Devices>{''.join(devices)}</Devices>{modules}{tail}").encode()


def load(xml, number=0):
    stream = io.BytesIO(xml)
    listed = list_devices(stream).devices[number]
    stream.seek(0)
    return load_device(stream, listed)


def test_list_has_every_device():
    other = '<Device><Type ProductCode="16" RevisionNo="#x10000">EL1</Type></Device>'
    found = list_devices(io.BytesIO(esi(DRIVE, other)))
    assert (found.vendor, found.vendor_name, found.findings) == (2, "V", ())
    assert [(d.product, d.revision, d.number, d.type, d.name, d.hides) for d in found.devices] == [
        (0x1B, 0x120000, 0, "AX1", "Drive", (0x110000,)),
        (16, 0x10000, 1, "EL1", "EL1", ()),
    ]


def test_device_has_the_fields_of_its_file():
    device = load(esi(DRIVE)).device
    assert (device.vendor, device.type, device.name, device.group) == (2, "AX1", "Drive", "Drives")
    assert device.revision_rule is RevisionRule.SAME_LOW_AT_LEAST
    assert (device.timeouts.preop_ms, device.timeouts.safeop_op_ms) == (3000, 10000)
    assert device.ebus_ma == -250
    assert device.sync_managers[0] == EsiSyncManager(
        use=SmUse.MAILBOX_OUT, start=0x1000, default_size=128, min_size=64, max_size=256,
        control=0x26,
    )  # fmt: skip
    assert [(each.start, each.is_enabled, each.op_only) for each in device.sync_managers[1:]] == [
        (0x1080, True, False),
        (0x1100, True, True),
        (0x1180, True, False),
    ]
    assert [(each.use, each.sync_manager) for each in device.fmmus] == [
        ("Outputs", None),
        ("Inputs", 3),
    ]
    first, second = device.pdos
    assert (first.index, first.name, first.sync_manager, first.excludes, first.bits) == (
        0x1600, "Drive Outputs", 2, (0x1601,), 24,
    )  # fmt: skip
    assert (second.is_fixed, second.sync_manager, second.entries) == (True, None, ())
    assert device.mailbox.coe.pdo_assign
    assert not device.mailbox.coe.pdo_config
    (command,) = device.init_commands
    assert (command.transitions, command.index, command.data) == (("PS",), 0x6060, b"\x08")
    assert device.op_modes[0].mode == OpMode(
        name="DC", activate=0x0730, factor0=1, shift0_ns=125, factor1=-2
    )
    assert device.eeprom.byte_size == 2048
    assert device.eeprom.config_data == bytes.fromhex("080C0088C4090100")


@pytest.mark.parametrize(
    ("head", "encoding"),
    [
        ('<?xml version="1.0" encoding="ISO-8859-1"?>', "latin-1"),
        ('\ufeff<?xml version="1.0" encoding="UTF-8"?>', "utf-8"),
    ],
)
def test_esi_file_is_read_in_its_encoding(head, encoding):
    text = esi('<Device><Type ProductCode="1">X</Type><Name>250 µs</Name></Device>').decode()
    xml = head + text.partition("?>")[2]
    assert load(xml.encode(encoding)).device.name == "250 µs"


def test_module_and_its_class_are_read_for_a_device_with_slots():
    device = """<Device><Type ProductCode="1">M</Type><Sm StartAddress="#x1000">Inputs</Sm>
      <Slots MaxSlotCount="4" SlotPdoIncrement="1" SlotIndexIncrement="16">
        <Slot MinInstances="0" MaxInstances="4"><ModuleClass><Class>A</Class></ModuleClass></Slot>
      </Slots></Device>"""
    modules = """<Modules>
      <Module><Type ModuleIdent="7" ModuleClass="A">In</Type><TxPdo Sm="0">
        <Index DependOnSlot="1">#x1a00</Index><Name>In</Name></TxPdo></Module>
      <Module><Type ModuleIdent="8" ModuleClass="B">Out</Type></Module></Modules>"""
    found = load(esi(device, modules=modules)).device
    assert [(m.ident, m.type, m.pdos[0].depends_on_slot) for m in found.modules] == [
        (7, "In", True)
    ]
    assert (found.slots[0].pdo_step, found.slots[0].index_step) == (1, 16)


def test_all_faults_of_a_device_are_found_with_their_lines():
    wrong = DRIVE.replace("#x6040", "#xZZ").replace('Sm="2"', 'Sm="9"').replace(">08<", ">0<")
    result = load(esi(wrong))
    assert result.device is None
    assert [(each.line, each.message) for each in result.findings] == [
        (17, "RxPdo 0x1600 is for sync manager 9"),
        (19, "Index is '#xZZ'"),
        (24, "Data of an InitCmd is '0'"),
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("#x1100", "#x11000", "Sm StartAddress is '#x11000'"),
        ("<BitLen>16<", "<BitLen>60000<", "an entry has 60000 bits"),
        (">Outputs</Sm>", ">Sideways</Sm>", "sync manager with use 'Sideways'"),
        ("<Index>#x1600</Index>", "", "a RxPdo has no index"),
        (">PS<", ">XY<", "an InitCmd is for transition XY"),
        ("<Index>#x6060</Index>", "", "an InitCmd writes nothing"),
        ("2048", "99999999", "an EEPROM of 99999999 bytes"),
        ("-250", "9" * 5000, "EBusCurrent is '9999"),
    ],
)
def test_fault_of_a_device(old, new, message):
    finding, *_ = load(esi(DRIVE.replace(old, new))).findings
    assert message in finding.message
    assert finding.line > 0


def test_pdo_at_a_sync_manager_of_the_other_direction_is_found():
    (finding,) = load(esi(DRIVE.replace('Sm="2"', 'Sm="3"'))).findings
    assert finding.message == "RxPdo 0x1600 is for sync manager 3 (Inputs)"


def test_missing_default_module_is_found():
    device = """<Device><Type ProductCode="1">M</Type><Slots><Slot MinInstances="1"
      MaxInstances="1"><ModuleIdent Default="1">7</ModuleIdent></Slot></Slots></Device>"""
    (finding,) = load(esi(device)).findings
    assert "the module 0x00000007 of slot 0 is missing" in finding.message


@pytest.mark.parametrize(
    ("xml", "message"),
    [
        (b"<a", "not XML that can be read"),
        (b"", "not XML that can be read"),
        (b"<a/>", "it begins with 'a'"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><EtherCATInfo>&b;</EtherCATInfo>", "entities"),
        (esi(DRIVE, tail=""), "not XML that can be read"),
        (b"<EtherCATInfo>" + b"<Descriptions>" * 100_000, "nested too deeply"),
    ],
)
def test_file_that_cannot_be_read_is_a_finding(xml, message):
    (finding,) = list_devices(io.BytesIO(xml)).findings
    assert message in finding.message


def test_devices_before_a_truncation_can_be_used():
    xml = esi(DRIVE, DRIVE)[:-600]
    found = list_devices(io.BytesIO(xml))
    assert (len(found.devices), len(found.findings)) == (2, 1)
    assert load_device(io.BytesIO(xml), found.devices[0]).device.type == "AX1"


def test_device_that_is_gone_is_a_finding():
    listed = list_devices(io.BytesIO(esi(DRIVE))).devices[0]
    other = esi(DRIVE.replace("#x1B", "#x1C"))
    (finding,) = load_device(io.BytesIO(other), listed).findings
    assert "has no AX1 (revision 0x00120000) any more" in finding.message


def test_device_without_a_type_does_not_shift_those_behind_it():
    assert load(esi("<Device/>", DRIVE)).device.type == "AX1"
