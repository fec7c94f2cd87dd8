"""Bus files with slaves that their vendors describe."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from devicebus.esi.records import EsiDevice, EsiPdo, EsiSyncManager, SmUse
from devicebus.sim.spec import DeviceKind, SlaveSpec
from eap.config.index import name_bus
from eap.od.slave_config import RevisionRule, SdoWrite
from eap.runtime import busfile
from eap.runtime.esi_slaves import describe_device

ROOT = Path(__file__).parents[4] / "config"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))
    shutil.copytree(ROOT / "esi", tmp_path / "esi")
    return tmp_path


def load(folder, *slaves, head="esi: esi"):
    lines = [f"  - {{kind: esi, {each}}}" for each in slaves]
    path = folder / "bus.yaml"
    path.write_text("\n".join(["bus: b", head, "slaves:", *lines, ""]))
    return busfile.load(path)


def findings(folder, *slaves, **more):
    return [str(each).removeprefix(f"{folder}/") for each in load(folder, *slaves, **more).findings]


def describe(folder, *slaves):
    assert load(folder, *slaves).findings == ()
    return busfile.describe(folder / "bus.yaml")


def test_revision_asked_for_is_built_and_expected(folder):
    bus = describe(
        folder,
        "name: a, device: DO4, revision: 0x00100000",
        "name: b, device: DO4",
        "name: c, device: do4-0000-0016",
    )
    assert [(each.revision, len(each.outputs)) for each in bus.slaves] == [
        (0x0010_0000, 2),
        (None, 4),
        (0x0010_0000, 2),
    ]
    built = busfile.load_or_raise(folder / "bus.yaml").build().segment.slaves
    revisions = [each.device.dictionary.entry(0x1018, 3).value for each in built]
    assert revisions == [0x0010_0000, 0x0012_0000, 0x0010_0000]


def test_variables_have_the_names_of_pdos_and_entries(folder):
    bus = describe(folder, "name: in, device: DI4", "name: ai, device: AI2")
    names = list(name_bus("bus0", bus).variables)
    assert names[3:5] == ["bus0.in.Channel_1.Input", "bus0.in.Channel_2.Input"]
    assert "bus0.ai.AI_Standard_Channel_2.Value" in names


def test_optional_pdo_has_the_first_sync_manager_that_is_set_up():
    device = EsiDevice(
        vendor=1,
        product=1,
        revision=1,
        sync_managers=(
            EsiSyncManager(use=SmUse.OUTPUTS, is_virtual=True),
            EsiSyncManager(use=SmUse.OUTPUTS, start=0x1000),
        ),
        pdos=(EsiPdo(index=0x1600, name="", is_output=True),),
    )
    described = describe_device(SlaveSpec(name="a", kind=DeviceKind.ESI), device)
    assert [each.manager for each in described.pdos] == [1]


def test_pdo_that_is_called_state_leaves_the_state_of_the_slave(folder):
    path = folder / "esi" / "terminals.xml"
    text = path.read_text().replace("<Name>Channel 1</Name>", "<Name>state</Name>")
    path.write_text(text)
    bus = describe(folder, "name: in, device: DI4")
    names = list(name_bus("bus0", bus).variables)
    assert len(set(names)) == len(names)
    assert "bus0.in.state" in names
    assert "bus0.in.state.Input" in names


def test_configuration_is_that_of_the_file(folder):
    (slave,) = describe(folder, "name: axis, device: SD1").slaves
    config = slave.config
    assert config.assignment == {2: (0x1600,), 3: (0x1A00,)}
    assert config.writes == (
        SdoWrite(index=0x6060, data=b"\x08", comment="cyclic synchronous position"),
    )
    assert config.sync.name == "DC Sync"
    assert config.revision_rule is RevisionRule.AT_LEAST
    assert config.timeouts.preop_ms == 5000
    assert [each.label for each in slave.pdos] == [
        "0x1600 (csp)",
        "0x1A00 (feedback)",
        "0x1601 (csv)",
    ]


def test_keys_of_the_master_change_the_configuration_of_the_file(folder):
    given = "name: axis, device: SD1, master: {pdos: [csv, feedback]}"
    (slave,) = describe(folder, given).slaves
    assert [(each.group, each.name) for each in slave.outputs] == [
        ("csv", "Controlword"),
        ("csv", "Target velocity"),
    ]


def test_named_assignment_of_the_file_is_chosen(folder):
    (slave,) = describe(folder, "name: ai, device: AI2, master: {pdos: [Compact]}").slaves
    assert slave.config.assignment == {3: (0x1A01, 0x1A03)}
    assert [(each.group, each.name) for each in slave.inputs] == [
        ("AI Compact Channel 1", "Value"),
        ("AI Compact Channel 2", "Value"),
    ]


def test_pdos_that_exclude_each_other_are_found(folder):
    found, *_ = findings(folder, "name: axis, device: SD1, master: {pdos: [csv, csp]}")
    assert "PDO 0x1601 (csv) excludes 0x1600 (csp)" in found


def test_all_findings_come_at_once(folder):
    found = findings(
        folder,
        "name: a, device: DO5",
        "name: b, device: DO4, revision: 0x00110000",
        "name: c",
        "name: d, device: DO4, esi: nowhere.xml",
    )
    assert [each.partition("; expected")[0] for each in found] == [
        "bus.yaml:4: a: esi: none of 7 devices is DO5, did you mean DO4?",
        "bus.yaml:5: b: esi: DO4 has no revision 0x00110000; known: 0x00100000, 0x00120000",
        "bus.yaml:6: c: esi is a folder",
        "bus.yaml:7: nowhere.xml cannot be read: does not exist",
    ]


def test_modules_of_slots_have_variables_and_start_up_writes(folder):
    (slave,) = describe(folder, "name: ms, device: MS4, modules: [RELAY, TEMP]").slaves
    assert [(each.index, each.group) for each in (*slave.outputs, *slave.inputs)] == [
        (0x7000, "Relay"),
        (0x6010, "Temperature"),
    ]
    *modules, sensor = slave.config.writes
    assert [(each.index, each.subindex) for each in modules] == [
        (0xF030, 0), (0xF030, 1), (0xF030, 2), (0xF030, 0),
    ]  # fmt: skip
    assert (sensor.index, sensor.data) == (0x8010, b"\x03\x00")


def test_module_that_does_not_fit_is_found(folder):
    (found,) = findings(folder, "name: e, device: DO4, modules: [IN]")
    assert (
        "bus.yaml:4: e: DO4 (revision 0x00120000) has no slots for modules, but 1 in modules"
        in found
    )


def test_slave_without_a_file_is_found(folder):
    (found,) = findings(folder, "name: a, device: DO4", head="cable_ns: 50")
    assert "bus.yaml:4: a: kind esi without a description; expected key esi" in found


def test_faults_of_the_device_are_found_with_file_and_line(folder):
    path = folder / "esi" / "drive.xml"
    text = path.read_text().replace('Sm="2"', 'Sm="7"').replace("<BitLen>8<", "<BitLen>many<")
    path.write_text(text)
    found = findings(folder, "name: axis, device: SD1")
    assert found[0] == (
        "bus.yaml:4: axis: SD1 cannot be used: 2 faults in its file; expected a description without"
        " faults"
    )
    assert [each.partition(":")[0] for each in found[1:]] == ["esi/drive.xml"] * 2
    assert "RxPdo 0x1600 is for sync manager 7" in found[1]
    assert "BitLen is 'many'" in found[2]


@pytest.mark.parametrize(
    "text", ["", "<EtherCATInfo>", "<!DOCTYPE a [<!ENTITY b 'c'>]><EtherCATInfo/>", "<a/>"]
)
def test_hostile_file_is_a_finding_with_its_line(folder, text):
    (folder / "bad.xml").write_text(text)
    found = findings(folder, "name: a, device: DO4, esi: bad.xml")
    assert any(each.startswith("bad.xml") for each in found)
