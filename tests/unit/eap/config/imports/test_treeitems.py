from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from eap.codec.xmlstream import XmlError, read_tree
from eap.config.imports.records import EapBox, EapImportDevice, EapVariable, ImportReport
from eap.config.imports.treeitems import assemble, device_items, read_tree_items, tree_items_text
from eap.ids import NetId

# Element for element as Beckhoff's sample for the Automation Interface builds it.
PUBLISHER = """\
<TreeItem><ItemName>Box 1</ItemName><PathName>TIID^Device 1^Box 1</PathName><ItemSubType>9051</ItemSubType>
<BoxDef><NvPubDef><Udp Enabled="0"/><PublisherNetId>2.2.3.4.1.1</PublisherNetId>
<MacAddress>01 01 05 04 00 07</MacAddress><IoDiv><Divider>3</Divider><Modulo>1</Modulo></IoDiv>
<VLAN><Enable>1</Enable><Id>5</Id><Prio>6</Prio></VLAN><ArpInterval>500</ArpInterval>
<DisableSubscriberMonitoring>1</DisableSubscriberMonitoring><TargetChangeable>1</TargetChangeable>
</NvPubDef></BoxDef></TreeItem>
"""  # noqa: E501
VARIABLE = """\
<TreeItem><ItemName>Speed</ItemName><PathName>TIID^Device 1^Box 1^Speed</PathName><ItemType>35</ItemType>
<NvPubVarDef><NvId>11</NvId></NvPubVarDef></TreeItem>
"""  # noqa: E501
DATA = """\
<TreeItem><PathName>TIID^Device 1^Box 1^Speed^Outputs^VarData</PathName><ItemType>7</ItemType>
<VarDef><VarType>DINT</VarType><VarBitSize>32</VarBitSize></VarDef></TreeItem>
"""
DEVICE = """\
<TreeItem><ItemName>Device 1</ItemName><PathName>TIID^Device 1</PathName><ItemSubType>112</ItemSubType>
<DeviceDef><AddressInfo><Pnp><DeviceData>020000000501</DeviceData></Pnp></AddressInfo></DeviceDef>
</TreeItem>
"""  # noqa: E501
TASK = """\
<TreeItem><ItemName>PlcTask</ItemName><PathName>TIRT^PlcTask</PathName><TaskDef>
<CycleTime>20000</CycleTime></TaskDef></TreeItem>
"""


def read(*files: str) -> tuple[tuple[EapImportDevice, ...], ImportReport]:
    report = ImportReport()
    items = [
        each
        for number, text in enumerate(files)
        for each in read_tree_items([text.encode()], f"{number}.xml", report)
    ]
    return assemble(items, report), report


def bare(device: EapImportDevice) -> EapImportDevice:
    """Return *device* without the places in its files."""
    boxes = tuple(
        replace(
            box, file="", line=0, variables=tuple(replace(each, line=0) for each in box.variables)
        )
        for box in device.boxes
    )
    return replace(device, file="", line=0, boxes=boxes)


EXPECTED = EapImportDevice(
    name="Device 1",
    mac="02:00:00:00:05:01",
    cycle_us=2_000,
    boxes=(
        EapBox(
            name="Box 1",
            is_publisher=True,
            net_id=NetId.parse("2.2.3.4.1.1"),
            mac="01:01:05:04:00:07",
            divider=3,
            modulo=1,
            vlan_id=5,
            vlan_priority=6,
            arp_ms=500,
            is_monitored=False,
            is_changeable=True,
            variables=(EapVariable(name="Speed", nv_id=11, type="DINT", bits=32),),
        ),
    ),
)


@pytest.mark.parametrize(
    "files",
    [
        (DEVICE, PUBLISHER, VARIABLE, DATA, TASK),
        (DATA, TASK, VARIABLE, PUBLISHER, DEVICE),
        (f"<TreeItems>{DEVICE}{PUBLISHER}{VARIABLE}{DATA}{TASK}</TreeItems>",),
    ],
)
def test_items_of_several_files_are_put_together(files: tuple[str, ...]) -> None:
    found, report = read(*files)
    assert not report.findings
    assert [bare(each) for each in found] == [EXPECTED]


def test_nested_items_need_no_path() -> None:
    inner = VARIABLE.replace("<PathName>TIID^Device 1^Box 1^Speed</PathName>", "")
    box = PUBLISHER.replace("<PathName>TIID^Device 1^Box 1</PathName>", "")
    text = DEVICE.replace("</TreeItem>", box.replace("</TreeItem>", inner + "</TreeItem>"))
    found, report = read(text + "</TreeItem>", DATA, TASK)
    assert not report.findings
    assert [bare(each) for each in found] == [EXPECTED]


def test_box_without_its_device_is_read() -> None:
    (device,), _ = read(PUBLISHER)
    assert (device.name, device.net_id, len(device.boxes)) == ("Device 1", None, 1)


@pytest.mark.parametrize(
    ("udp", "address"),
    [
        ("<Address>255.255.255.255</Address><Gateway>255.255.255.255</Gateway>", "255.255.255.255"),
        ("<Address>224.0.0.7</Address>", "224.0.0.7"),
        ("<Address>10.0.0.5</Address>", "10.0.0.5"),
    ],
)
def test_udp_publisher_has_its_address_only(udp: str, address: str) -> None:
    text = PUBLISHER.replace('<Udp Enabled="0"/>', f'<Udp Enabled="1">{udp}</Udp>')
    (device,), _ = read(text)
    (box,) = device.boxes
    assert (box.udp, box.mac, box.gateway) == (address, "", "")


def test_unknown_settings_are_kept() -> None:
    (device,), _ = read(PUBLISHER.replace("</NvPubDef>", "<OnChange>1</OnChange></NvPubDef>"))
    assert [each.text for each in device.boxes[0].unknown] == ["NvPubDef/OnChange 1"]


def test_every_wrong_item_is_a_finding() -> None:
    wrong = (
        PUBLISHER.replace("2.2.3.4.1.1", "2.2.3"),
        PUBLISHER.replace("01 01 05", "01 01"),
        PUBLISHER.replace("<Divider>3", "<Divider>0"),
        VARIABLE.replace("<NvId>11</NvId>", ""),
        DATA.replace("32", "x"),
        "<TreeItem>",
    )
    _, report = read(*wrong)
    messages = {each.file: each.message for each in report.findings}
    assert messages == {
        "0.xml": "'2.2.3' is not an AMS NetID",
        "1.xml": "MAC address '01 01 04 00 07'",
        "2.xml": "Divider is '0'",
        "3.xml": "NvPubVarDef has no NvId",
        "4.xml": "VarBitSize is 'x'",
        "5.xml": "not XML that can be read: no element found",
    }


def test_other_devices_are_left() -> None:
    found, report = read(DEVICE.replace("112", "111"))
    assert not found
    assert [each.message for each in report.notes] == ["ItemSubType 111: no EAP device"]


NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z"), exclude_characters="^"))
NET_IDS = st.binary(min_size=6, max_size=6).filter(any).map(NetId) | st.none()
MACS = st.sampled_from(("", "01:01:05:04:00:07", "ff:ff:ff:ff:ff:ff", "02:00:00:00:00:01"))
U16 = st.integers(0, 0xFFFF)
VARIABLES = st.builds(
    EapVariable,
    name=NAMES.filter(bool),
    nv_id=U16,
    type=st.sampled_from(("DINT", "ARRAY [0..3] OF BYTE", "ST_A")),
    bits=U16,
    version=U16,
)
BOXES = st.builds(
    EapBox,
    name=NAMES.filter(bool),
    is_publisher=st.just(True),
    net_id=NET_IDS,
    mac=MACS,
    divider=st.integers(1, 0xFFFF),
    modulo=U16,
    vlan_id=st.integers(1, 4094),
    vlan_priority=st.integers(0, 7),
    arp_ms=U16,
    is_monitored=st.booleans(),
    is_changeable=st.booleans(),
    is_disabled=st.booleans(),
    variables=st.lists(VARIABLES, max_size=3, unique_by=lambda each: each.name).map(tuple),
)
SUBSCRIBERS = st.builds(
    EapBox, name=NAMES.filter(bool), is_publisher=st.just(False), net_id=NET_IDS, mac=MACS
)
DEVICES = st.builds(
    EapImportDevice,
    name=NAMES.filter(bool),
    net_id=NET_IDS,
    mac=st.sampled_from(("", "02:00:00:00:05:01")),
    cycle_us=st.integers(1, 60_000_000),
    is_disabled=st.booleans(),
    boxes=st.lists(BOXES | SUBSCRIBERS, max_size=3, unique_by=lambda each: each.name).map(tuple),
)


@given(DEVICES)
def test_devices_round_trip(device: EapImportDevice) -> None:
    found, report = read(tree_items_text([device]))
    assert not report.findings
    assert [bare(each) for each in found] == [device]


@given(DEVICES)
def test_single_items_round_trip(device: EapImportDevice) -> None:
    found, _ = read(*(text for _, text in device_items(device)))
    assert [bare(each) for each in found] == [device]


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(text: str) -> None:
    with suppress(XmlError):
        read_tree([text])
    read(f"<TreeItem>{text}</TreeItem>".encode(errors="replace").decode())
