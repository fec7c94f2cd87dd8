from __future__ import annotations

from pathlib import Path

import pytest

from eap.config.imports import twincat
from eap.config.imports.records import EapVariable, ImportReport
from eap.config.imports.twincat import read_project
from eap.ids import NetId
from tests.support.pages import ROOT
from tests.support.twincat import (
    DEVICE,
    device,
    instance,
    item,
    links,
    project,
    publisher,
    read,
    subscriber,
)

SPEED = ("Speed", 11, "DINT", 4)
STATE = publisher("State", SPEED, ("Running", 12, "BOOL", 1))


def outcomes(report: ImportReport) -> list[str]:
    return [f"{each.outcome} {each.item}: {each.message}" for each in report.notes]


def findings(report: ImportReport) -> list[str]:
    return [str(each) for each in report.findings]


def test_project_is_read_with_its_publishers_and_subscribers() -> None:
    def open_file(path: str) -> list[bytes]:
        return [Path(path).read_bytes()]

    report = ImportReport()
    found = read_project(str(ROOT / "docs" / "examples" / "Line.tsproj"), open_file, report)
    assert not report.findings
    assert found.net_id == NetId.parse("192.168.5.1.1.1")
    assert found.cycles_us == (10_000,)
    assert [each.name for each in found.types] == ["ST_Axis", "E_Mode"]
    (eap,) = found.devices
    assert (eap.name, str(eap.net_id), eap.mac) == (DEVICE, "192.168.5.1.2.1", "02:00:00:00:05:01")
    assert [(box.name, box.is_publisher, str(box.net_id)) for box in eap.boxes] == [
        ("State", True, "192.168.5.2.1.1"),
        ("Axis", True, "192.168.5.2.1.1"),
        ("Recipe", True, "192.168.5.2.1.1"),
        ("Commands", False, "192.168.5.2.1.1"),
        ("Target", False, "192.168.5.2.1.1"),
        ("Order", False, "192.168.5.2.1.1"),
    ]
    speed, running = eap.boxes[0].variables
    assert speed == EapVariable(
        name="Speed", nv_id=11, type="DINT", bits=32, symbol="MAIN.nSpeed", cycle_us=10_000,
        line=speed.line,
    )  # fmt: skip
    assert (running.type, running.bits) == ("BOOL", 8)
    assert eap.boxes[1].variables[0].guid.startswith("{7A1D0000")
    assert eap.boxes[3].variables[0].symbol == "MAIN.fSetpoint"
    assert outcomes(report) == [
        (
            "left Device 2 (EtherCAT): DevType 111: EtherCAT master: an ENI file, or 'eapctl bus"
            " scan --write', describes its slaves"
        )
    ]


def test_devices_and_boxes_are_read_from_their_files() -> None:
    eap = item(
        device('<Box File="Box 1 (State).xti" Id="1"/>', name="__FILENAME__"),
        '<Mappings><OwnerA Name="TIPC^Line^Line Instance"><OwnerB>'
        '<Link VarA="PlcTask Outputs^MAIN.n" VarB="Box 1 (State)^Speed^Outputs^VarData"/>'
        "</OwnerB></OwnerA></Mappings>",
    )
    box = item(STATE.replace("<Name>State<", "<Name>__FILENAME__<"), kind="CNvBox")
    files = {
        "p/_Config/IO/Device 1 (X).xti": eap,
        "p/_Config/IO/Device 1 (X)/Box 1 (State).xti": box,
    }
    plc = instance(("PlcTask", 2_000))
    found, report = read(project('<Device File="Device 1 (X).xti" Id="1"/>', plc=plc), files)
    assert not report.findings
    (eap_device,) = found.devices
    (state,) = eap_device.boxes
    assert (eap_device.name, state.name) == ("Device 1 (X)", "Box 1 (State)")
    assert state.file == "p/_Config/IO/Device 1 (X)/Box 1 (State).xti"
    assert (state.variables[0].symbol, state.variables[0].cycle_us) == ("MAIN.n", 2_000)


def test_file_of_a_device_is_read_by_itself() -> None:
    files = {"io/Device 1 (X)/State.xti": item(STATE)}
    text = item(device('<Box File="State.xti"/>', name="__FILENAME__"))
    found, report = read(text, files, file="io/Device 1 (X).xti")
    assert not report.findings
    assert [each.name for each in found.devices] == ["Device 1 (X)"]
    assert [box.name for box in found.devices[0].boxes] == ["State"]


def test_file_of_a_box_alone_is_refused() -> None:
    _, report = read(item(STATE), file="State.xti")
    assert findings(report) == [
        (
            "State.xti:1: a box without its device: its NetID is unknown; expected the file of its"
            " device, or the project"
        )
    ]


@pytest.mark.parametrize("name", ["../x.xti", "..", "a/b.xti", "a\\b.xti", "C:x.xti"])
def test_files_outside_the_project_are_refused(name: str) -> None:
    found, report = read(project(f'<Device File="{name}"/>', device(f'<Box File="{name}"/>')))
    assert [str(each) for each in report.findings] == [
        (
            f"p/Line.tsproj:1: File {name!r} leads out of the folder of the project; expected the"
            " name of a file in the folder"
        )
    ] * 2
    assert [each.boxes for each in found.devices] == [()]


def test_missing_file_is_a_finding_and_the_rest_is_read() -> None:
    found, report = read(project('<Device File="gone.xti"/>', device(STATE)))
    assert findings(report) == [
        (
            "p/_Config/IO/gone.xti: cannot be read: No such file or directory; expected a file of"
            " the project, in its folder"
        )
    ]
    assert [each.name for each in found.devices] == [DEVICE]


def test_file_without_the_device_or_box_is_noted() -> None:
    files = {
        "p/_Config/IO/a.xti": item(STATE),
        f"p/_Config/IO/{DEVICE}/b.xti": item("<Other/>"),
    }
    text = project('<Device File="a.xti"/>', device('<Box File="b.xti"/>'))
    found, report = read(text, files)
    assert outcomes(report) == ["left a: its file has no Device", "left b: its file has no Box"]
    assert [each.boxes for each in found.devices] == [()]


def test_number_of_files_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(twincat, "MAX_FILES", 3)
    files = {"p/_Config/IO/a.xti": item(device(STATE))}
    found, report = read(project(*['<Device File="a.xti"/>'] * 9), files)
    assert findings(report) == [
        "p/Line.tsproj: the project names too many files; expected at most 3"
    ]
    assert len(found.devices) == 2


def test_every_wrong_part_is_a_finding_of_its_own() -> None:
    boxes = (
        publisher("A", ("V", 70_000, "DINT", 4)),
        publisher("B", SPEED, eap='InOut="1" Publisher="xyz"'),
        publisher("C", SPEED, box='Disabled="maybe"'),
        subscriber("D", SPEED).replace('NvId="11"', ""),
        STATE,
    )
    found, report = read(project(device(*boxes), target='TargetNetId="1.2.3"'))
    assert [str(each).partition(": ")[2] for each in report.findings] == [
        "'1.2.3' is not an AMS NetID; expected six numbers from 0 to 255, such as 5.23.91.23.1.1",
        "EapVar NvId is '70000'; expected a whole number from 0 to 65535",
        "Publisher is 'xyz'; expected a NetID of 12 hexadecimal digits",
        "Box Disabled is 'maybe'; expected true, false, 1 or 0",
        "EapVar 'V' has no NvId; expected the attribute NvId".replace("'V'", "'Speed'"),
    ]
    assert [each.path for each in report.findings[1:3]] == [f"{DEVICE}/A/V", f"{DEVICE}/B"]
    assert [box.name for box in found.devices[0].boxes] == ["A", "D", "State"]


def test_unknown_settings_are_kept_with_their_lines() -> None:
    box = publisher(
        "A", SPEED, eap='InOut="1" Publisher="c0a805020101"\nTargetMac="0102"', more='OnChange="1"'
    ).replace("</Eap>", "<Vlan>5</Vlan></Eap>")
    found, report = read(project(device(box)))
    assert not report.findings
    (publisher_a,) = found.devices[0].boxes
    assert [(each.line, each.text) for each in publisher_a.unknown] == [
        (1, 'Eap TargetMac="0102"'),
        (5, "Eap/Vlan 5"),
    ]
    assert [each.text for each in publisher_a.variables[0].unknown] == ['EapVar OnChange="1"']


def test_other_devices_and_boxes_are_left_with_the_reason() -> None:
    other = '<Device Id="9" DevType="138"><Name>RT</Name></Device>'
    odd = '<Box Id="7" BoxType="9900"><Name>Power</Name></Box>'
    found, report = read(project(other, device(odd), device(more='Disabled="true"', name="Off")))
    assert outcomes(report) == [
        (
            "left RT: DevType 138: Real-Time Ethernet adapter: network variables of TwinCAT 2 are"
            " not read from it"
        ),
        f"left {DEVICE}/Power: BoxType 9900: neither publisher nor subscriber",
    ]
    assert [each.is_disabled for each in found.devices] == [False, True]


def test_net_id_of_a_project_without_a_target_is_not_taken() -> None:
    found, report = read(project(device(STATE, net_id="0.0.0.0.4.1"), target=""))
    assert (found.net_id, found.devices[0].net_id) == (None, None)
    assert outcomes(report) == [f"warning {DEVICE}: its AmsNetId 0.0.0.0.4.1 belongs to no system"]


@pytest.mark.parametrize("cycle_us", [500, 10_000])
def test_cycle_is_that_of_the_linked_task(cycle_us: int) -> None:
    mapping = links("State", ("Fast Outputs^MAIN.n", "Speed^Outputs^VarData"))
    text = project(device(STATE), plc=instance(("Fast", cycle_us)), mappings=mapping)
    found, _ = read(text)
    assert [each.cycle_us for each in found.devices[0].boxes[0].variables] == [cycle_us, 0]


def test_link_of_a_task_image_has_the_cycle_of_the_task() -> None:
    mapping = links(
        "State", ("Outputs^n", "Speed^Outputs^VarData"), owner="TIRT^Task 2"
    )  # fmt: skip
    text = project(device(STATE), tasks=[("Task 2", 4_000)], mappings=mapping)
    found, _ = read(text)
    assert found.devices[0].boxes[0].variables[0].cycle_us == 4_000


def test_truncated_and_hostile_projects_are_findings() -> None:
    text = project(device(STATE))
    for broken in (text[: len(text) // 2], f"<!DOCTYPE x [<!ENTITY a 'b'>]>{text}", "", "<Other/>"):
        _, report = read(broken)
        assert len(report.findings) == 1
