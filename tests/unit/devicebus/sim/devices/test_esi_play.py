"""Devices of ESI files on a simulated bus, under our master."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from devicebus.errors import AlStatusError
from devicebus.esi.choice import default_config, plan_device
from devicebus.esi.content import list_devices, load_device
from devicebus.mailbox import coe_client, soe_client
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.master.matching import ExpectedSlave
from devicebus.sim.devices.build import build_segment
from devicebus.sim.devices.drive import DriveState
from devicebus.sim.spec import BusSpec, DeviceKind, ProfileKind, SlaveSpec
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState
from eap.codec.soe import Element, Idn
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.slave_config import SlaveConfig
from tests.support.busline import Paced

ESI = Path(__file__).parents[5] / "config" / "esi"
CYCLE_NS = 2_000_000


def device_of(xml, type_name=""):
    stream = io.BytesIO(xml.encode())
    listed = [d for d in list_devices(stream).devices if d.type.startswith(type_name)][-1]
    stream.seek(0)
    result = load_device(stream, listed)
    assert result.findings == ()
    return result.device


def shipped(name, type_name):
    return device_of((ESI / name).read_text(), type_name)


def wire(device, config=None, modules=None, **spec):
    """Return a line with one slave of *device* under a master that configures it."""
    given = SlaveSpec(name="x", kind=DeviceKind.ESI, modules=modules, **spec)
    segment = build_segment(BusSpec(bus="b", slaves=(given,)), {}, {"x": device})
    plan = plan_device(device, modules)
    expected = ExpectedSlave(
        name="x",
        vendor=device.vendor,
        product=device.product,
        config=default_config(plan) if config is None else config,
    )
    return Paced(Master(MasterSettings(expected=(expected,), cycle_ns=CYCLE_NS)), segment)


def started(device, config=None, modules=None, **spec):
    line = wire(device, config, modules, **spec)
    line.wait(line.core.bring_up(line.now_ns))
    return line


def slave_of(line):
    return line.segment.slaves[0]


def test_digital_outputs_are_in_the_registers_of_the_controller():
    line = started(shipped("terminals.xml", "DO4"))
    slave = slave_of(line)
    assert slave.esc.emulates_device
    line.core.image.outputs[:] = b"\x05"
    line.elapse(4 * CYCLE_NS)
    assert slave.esc.memory[0x0F00] == 5
    assert [slave.device.dictionary.entry(0x7000 + 0x10 * n, 1).value for n in range(4)] == [
        True, False, True, False,
    ]  # fmt: skip


def test_outputs_of_a_terminal_without_application_go_off_by_the_watchdog():
    line = started(shipped("terminals.xml", "DO4"))
    slave = slave_of(line)
    line.core.image.outputs[:] = b"\x05"
    line.elapse(4 * CYCLE_NS)
    slave.handle_timeout(line.now_ns + 1_000_000_000)
    assert not slave.device.dictionary.entry(0x7000, 1).value
    assert slave.state is AlState.OP


def test_drive_runs_its_state_machine_and_follows_its_target_position():
    line = started(shipped("drive.xml", "SD1"))
    image = line.core.image
    for word, state in (
        (6, DriveState.READY_TO_SWITCH_ON),
        (7, DriveState.SWITCHED_ON),
        (15, DriveState.OPERATION_ENABLED),
    ):
        image.write(1001, "Controlword", word)
        line.elapse(6 * CYCLE_NS)
        assert image.read(1001, "Statusword") & 0x6F == state
    image.write(1001, "Target position", 1234)
    line.elapse(6 * CYCLE_NS)
    assert image.read(1001, "Position actual value") == 1234
    assert image.read(1001, "Mode display") == 8


def test_drive_without_sync0_is_refused_in_op():
    with pytest.raises(AlStatusError, match="0x0030"):
        started(shipped("drive.xml", "SD1"), SlaveConfig())


def test_profile_none_is_a_device_without_behaviour():
    line = started(shipped("drive.xml", "SD1"), profile=ProfileKind.NONE)
    line.core.image.write(1001, "Controlword", 6)
    line.elapse(6 * CYCLE_NS)
    assert line.core.image.read(1001, "Statusword") == 0


def test_profile_drive_needs_its_objects():
    with pytest.raises(ValueError, match="profile drive: the device has no objects 0x6040"):
        wire(shipped("terminals.xml", "AI2"), profile=ProfileKind.DRIVE)


def converse(line, conversation):
    mailbox = line.core.slaves[1001].mailbox
    return line.wait(mailbox.converse(conversation(mailbox.sizes), line.now_ns))


def download(line, index, subindex, data):
    return converse(line, lambda sizes: coe_client.download(index, subindex, data, sizes))


def preop(device):
    line = wire(device, SlaveConfig())
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    return line


def test_assignment_can_be_written_where_the_file_allows_it():
    line = preop(shipped("terminals.xml", "AI2"))
    for sub, number, size in ((0, 0, 1), (1, 0x1A01, 2), (2, 0x1A03, 2), (0, 2, 1)):
        download(line, 0x1C13, sub, number.to_bytes(size, "little"))
    slave_of(line).device.process_data.configure()
    assert slave_of(line).device.process_data.inputs.size == 4


def test_pdos_that_exclude_each_other_are_refused():
    line = preop(shipped("terminals.xml", "AI2"))
    for sub, number, size in ((0, 0, 1), (1, 0x1A00, 2), (2, 0x1A01, 2)):
        download(line, 0x1C13, sub, number.to_bytes(size, "little"))
    with pytest.raises(SdoAbortError) as refused:
        download(line, 0x1C13, 0, b"\2")
    assert refused.value.code == AbortCode.PARAMETER


def test_fixed_mapping_is_read_only():
    line = preop(shipped("terminals.xml", "AI2"))
    with pytest.raises(SdoAbortError) as refused:
        download(line, 0x1A00, 0, b"\0")
    assert refused.value.code == AbortCode.READ_ONLY
    line = preop(shipped("drive.xml", "SD1"))
    download(line, 0x1600, 0, b"\0")


def test_eeprom_has_pdos_clock_modes_and_strings():
    line = wire(shipped("terminals.xml", "AI2"))
    image = sii.decode(slave_of(line).esc.image)
    assert sii.is_intact(slave_of(line).esc.image)
    assert len(slave_of(line).esc.image) == 2048
    assert image.fixed.size == 15
    assert [
        (hex(pdo.header.index), image.string(pdo.header.name), pdo.header.sync_manager)
        for pdo in image.tx_pdos
    ] == [
        ("0x1a00", "AI Standard Channel 1", 3),
        ("0x1a02", "AI Standard Channel 2", 3),
        ("0x1a01", "AI Compact Channel 1", 0xFF),
        ("0x1a03", "AI Compact Channel 2", 0xFF),
    ]
    assert [(image.string(dc.name), dc.assign_activate) for dc in image.dc] == [
        ("Synchron", 0),
        ("DC", 0x700),
    ]
    assert (image.fixed.boot_receive_offset, image.fixed.boot_send_size) == (0x1000, 0xF4)
    assert image.string(image.general.order) == "AI2"
    assert image.general.coe_pdo_assign
    assert not image.general.coe_pdo_configuration


def test_whole_image_of_a_file_is_kept_but_for_alias_and_serial_number():
    text = (ESI / "drive.xml").read_text()
    image = slave_of(wire(device_of(text))).esc.image
    given = text.replace("<ByteSize>4096", f"<Data>{image.hex()}</Data><ByteSize>4096")
    copy = slave_of(wire(device_of(given), serial=7, alias=9)).esc.image
    read = sii.decode(copy)
    assert (read.fixed.serial, read.fixed.alias, sii.is_intact(copy)) == (7, 9, True)
    assert (len(copy), read.rx_pdos) == (len(image), sii.decode(image).rx_pdos)
    with pytest.raises(ValueError, match="its EEPROM image cannot be used"):
        wire(device_of(text.replace("<ByteSize>4096", "<Data>0102</Data><ByteSize>4096")))


HEAD = "<EtherCATInfo><Vendor><Id>2</Id></Vendor><Descriptions><Devices>"
TAIL = "</Devices></Descriptions></EtherCATInfo>"


def entry(index, subindex, bits, name, kind):
    return (
        f"<Entry><Index>{index}</Index><SubIndex>{subindex}</SubIndex><BitLen>{bits}</BitLen>"
        f"<Name>{name}</Name><DataType>{kind}</DataType></Entry>"
    )


SOE = f"""{HEAD}<Device Physics="YY"><Type ProductCode="5" RevisionNo="1">AX2</Type>
  <Sm DefaultSize="128" StartAddress="#x1800" ControlByte="#x26">MBoxOut</Sm>
  <Sm DefaultSize="128" StartAddress="#x1a00" ControlByte="#x22">MBoxIn</Sm>
  <Sm StartAddress="#x1000" ControlByte="#x24">Outputs</Sm>
  <Sm StartAddress="#x1100" ControlByte="#x22">Inputs</Sm>
  <RxPdo Mandatory="1" Sm="2"><Index>24</Index><Name>MDT 1</Name>
    {entry(134, 0, 16, "Master control word", "UINT").replace("<Entry>", '<Entry Fixed="true">')}
    {entry(47, 0, 32, "Position command", "DINT")}</RxPdo>
  <RxPdo Mandatory="1" Sm="2"><Index>#x1018</Index><Name>MDT 2</Name>
    {entry(134, 0, 16, "Master control word", "UINT")}
    {entry(47, 0, 32, "Position command", "DINT")}</RxPdo>
  <TxPdo Mandatory="1" Sm="3"><Index>16</Index><Name>AT 1</Name>
    {entry(135, 0, 16, "Drive status word", "UINT")}
    {entry(51, 0, 32, "Position feedback", "DINT")}</TxPdo>
  <TxPdo Mandatory="1" Sm="3"><Index>#x1010</Index><Name>AT 2</Name>
    {entry(135, 0, 16, "Drive status word", "UINT")}
    {entry(51, 0, 32, "Position feedback", "DINT")}</TxPdo>
  <Mailbox><SoE ChannelCount="2">
    <InitCmd Chn="1"><Transition>PS</Transition><IDN>32</IDN><Data>0b00</Data></InitCmd>
    <InitCmd><Transition>IP</Transition><IDN>32778</IDN><Data>FE7F000000000000</Data></InitCmd>
  </SoE></Mailbox></Device>{TAIL}"""


def test_soe_drives_follow_their_command_values():
    line = started(device_of(SOE))
    image = line.core.image
    image.outputs[:] = bytes.fromhex("00e0 10000000 0000 20000000")
    line.elapse(6 * CYCLE_NS)
    assert image.inputs.hex(" ", 6) == "00c010000000 004000000000"
    value = converse(line, lambda _: soe_client.read(Idn.of(32), drive=1))
    assert value[-2:] == b"\x0b\x00"


def test_soe_list_changes_the_telegram():
    line = wire(device_of(SOE))
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    device = slave_of(line).device
    (first, *_) = [
        each for each in device.mailbox.protocols.values() if type(each).__name__ == "SoeServer"
    ]
    parameter = first.drives[0][24]
    parameter.write(Element.VALUE, b"\0\0\x40\0", device.od_state(), 0)
    device.process_data.configure()
    assert device.process_data.outputs.size == 2 + 6


MODULAR = f"""{HEAD}<Device><Type ProductCode="6" RevisionNo="1">M</Type>
  <Sm DefaultSize="128" StartAddress="#x1000" ControlByte="#x26">MBoxOut</Sm>
  <Sm DefaultSize="128" StartAddress="#x1080" ControlByte="#x22">MBoxIn</Sm>
  <Sm StartAddress="#x1100" ControlByte="#x24">Outputs</Sm>
  <Sm StartAddress="#x1200" ControlByte="#x20">Inputs</Sm>
  <Mailbox><CoE SdoInfo="1" PdoAssign="1"/></Mailbox>
  <Slots DownloadModuleIdentList="1" MaxSlotCount="4" SlotPdoIncrement="1" SlotIndexIncrement="16">
    <Slot MinInstances="0" MaxInstances="4"><ModuleIdent>#x10</ModuleIdent>
      <ModuleIdent>#x20</ModuleIdent></Slot></Slots></Device></Devices><Modules>
  <Module><Type ModuleIdent="#x10">IN</Type><TxPdo Sm="3"><Index DependOnSlot="1">#x1a00</Index>
    <Name>In</Name>{
    entry("#x6000", 1, 8, "Value", "USINT").replace("<Index>", '<Index DependOnSlot="1">')
}</TxPdo></Module>
  <Module><Type ModuleIdent="#x20">OUT</Type><RxPdo Sm="2"><Index DependOnSlot="1">#x1600</Index>
    <Name>Out</Name>{
    entry("#x7000", 1, 16, "Value", "UINT").replace("<Index>", '<Index DependOnSlot="1">')
}</RxPdo></Module>
  </Modules></Descriptions></EtherCATInfo>"""


def test_modules_are_in_their_slots():
    line = started(device_of(MODULAR), modules=("IN", None, 0x20, "IN"))
    dictionary = slave_of(line).device.dictionary
    assert [index for index in (0x6000, 0x6010, 0x7020, 0x6030) if index in dictionary] == [
        0x6000,
        0x7020,
        0x6030,
    ]
    assert [dictionary.entry(0xF050, sub).value for sub in range(1, 5)] == [0x10, 0, 0x20, 0x10]
    written = [(each.subindex, each.data) for each in line.core.slaves[1001].config.writes]
    assert written == [
        (0, b"\0"),
        *((sub, bytes((ident, 0, 0, 0))) for sub, ident in enumerate((0x10, 0, 0x20, 0x10), 1)),
        (0, b"\4"),
    ]
    assert (len(line.core.image.outputs), len(line.core.image.inputs)) == (2, 2)


def test_several_sync_managers_of_one_direction():
    xml = f"""{HEAD}<Device><Type ProductCode="7" RevisionNo="1">T</Type>
      <Sm StartAddress="#x0f00" ControlByte="#x44">Outputs</Sm>
      <Sm StartAddress="#x0f01" ControlByte="#x44">Outputs</Sm>
      <Sm StartAddress="#x1000" ControlByte="#x00">Inputs</Sm>
      <RxPdo Sm="0"><Index>#x1600</Index><Name>A</Name>{entry("#x7000", 1, 8, "a", "USINT")}</RxPdo>
      <RxPdo Sm="1"><Index>#x1601</Index><Name>B</Name>{entry("#x7010", 1, 8, "b", "USINT")}</RxPdo>
      <TxPdo Sm="2"><Index>#x1a00</Index><Name>C</Name>{entry("#x6000", 1, 8, "c", "USINT")}</TxPdo>
      </Device>{TAIL}"""
    line = started(device_of(xml))
    line.core.image.outputs[:] = b"\x12\x34"
    slave_of(line).device.dictionary.entry(0x6000, 1).value = 0x56
    line.elapse(6 * CYCLE_NS)
    dictionary = slave_of(line).device.dictionary
    assert [dictionary.entry(index, 1).value for index in (0x7000, 0x7010)] == [0x12, 0x34]
    assert line.core.image.inputs == b"\x56"


def test_virtual_sync_manager_is_mapped_and_not_set_up():
    xml = f"""{HEAD}<Device><Type ProductCode="7" RevisionNo="1">L</Type>
      <Sm StartAddress="#x1000" ControlByte="#x00">Inputs</Sm>
      <Sm StartAddress="#x0990" Virtual="true">Inputs</Sm>
      <TxPdo Sm="0"><Index>#x1a00</Index><Name>C</Name>{entry("#x6000", 1, 8, "c", "USINT")}</TxPdo>
      <TxPdo Sm="1" Virtual="1"><Index>#x1a10</Index><Name>DC</Name>
        {entry("#x1d09", "#x90", 64, "NextSync0", "ULINT")}</TxPdo><Dc/></Device>{TAIL}"""
    line = started(device_of(xml))
    controller = slave_of(line).esc
    controller.memory[0x0990:0x0998] = bytes.fromhex("0102030405060708")
    line.elapse(4 * CYCLE_NS)
    assert line.core.image.inputs[1:] == bytes.fromhex("0102030405060708")
    assert controller.memory[0x0808:0x0810] == bytes(8)


def test_pdo_index_that_is_an_object_is_refused():
    xml = (
        f'{HEAD}<Device><Type ProductCode="7">T</Type><Sm StartAddress="#x1000">Inputs</Sm>'
        + 2 * "<TxPdo><Index>#x1a00</Index><Name>A</Name></TxPdo>"
        + f"</Device>{TAIL}"
    )
    with pytest.raises(ValueError, match="PDO 0x1A00 is there twice"):
        wire(device_of(xml))
