"""Bus files of the slaves that are found on a bus."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.cli.group import main
from eap.config.index import name_bus
from eap.runtime import busfile
from tests.support.loopbus import LoopBus

CONFIG = Path(__file__).parents[4] / "config"
WHERE = ["--interface", "udp://127.0.4.1"]


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))


@pytest.fixture
def written(tmp_path, capsys, monkeypatch):
    """Scan a simulated bus; return the written file and what is shown."""

    def scan(bus, *words, expected=0, folder=CONFIG / "buses"):
        LoopBus(bus, folder).replace(monkeypatch)
        file = tmp_path / "found.yaml"
        with pytest.raises(SystemExit) as end:
            main(["bus", "scan", *WHERE, "--write", str(file), *words], prog_name="eapctl")
        out, err = capsys.readouterr()
        assert end.value.code == expected, err
        return file, out + err

    return scan


def variables(path):
    return {
        name: (each.type, each.is_output)
        for name, each in name_bus("bus0", busfile.describe(path)).variables.items()
    }


def identities(path):
    return [
        (each.name, each.vendor, each.product, each.revision)
        for each in busfile.describe(path).slaves
    ]


def test_bus_of_a_vendors_devices_has_the_same_variables(written):
    file, shown = written("cell", "--esi", str(CONFIG / "esi"))
    assert variables(file) == variables(CONFIG / "buses" / "cell.yaml")
    assert identities(file)[4] == ("axis", 0xE5A, 0x5D01, 0x20000)
    assert "drive.xml (SD1)" in shown
    assert "found.yaml written: 5 slaves" in shown


@pytest.mark.parametrize("bus", ["cell", "coe", "drive", "io"])
def test_bus_without_descriptions_has_the_same_variables(written, bus):
    file, shown = written(bus)
    assert variables(file) == variables(CONFIG / "buses" / f"{bus}.yaml")
    assert "EEPROM and objects" in shown


def test_wiring_of_branches_is_written(written):
    file, _ = written("io")
    found, original = (
        [
            (each.name, each.after or "", each.port)
            for each in busfile.load_or_raise(path).spec.slaves
        ]
        for path in (file, CONFIG / "buses" / "io.yaml")
    )
    assert [each[0] for each in found] == [
        each.name for each in busfile.describe(CONFIG / "buses" / "io.yaml").slaves
    ]
    assert {each for each in original if each[1]} <= set(found)


def test_slave_that_no_file_describes_has_a_note(written):
    file, shown = written("coe", "--esi", str(CONFIG / "esi"))
    assert "coupler: no description of vendor 0x00000E5A, product 0x044C2C52" in shown
    assert "# no description of vendor" in file.read_text()


def test_slave_with_a_newer_revision_is_described_by_an_older_one(written, tmp_path):
    text = (CONFIG / "esi" / "drive.xml").read_text()
    old = tmp_path / "old.xml"
    old.write_text(
        text.replace("#x00020000", "#x00010000").replace('CheckRevisionNo="EQ_OR_G"', "")
    )
    file, shown = written("cell", "--esi", str(old))
    assert "axis: described as revision 0x00010000, it has 0x00020000" in shown
    axis = busfile.describe(file).slaves[4]
    assert (axis.revision, str(axis.config.revision_rule)) == (0x10000, "same_low_at_least")


def test_other_assignment_of_a_slave_is_kept(written, tmp_path):
    text = (CONFIG / "esi" / "drive.xml").read_text()
    # The file assigns another PDO than the slave has.
    other = text.replace('<RxPdo Sm="2">', "<RxPdo>", 1).replace("<RxPdo>", "<RxPdo >", 1)
    other = other.replace("<RxPdo>", '<RxPdo Sm="2">', 1)
    (tmp_path / "esi").mkdir()
    (tmp_path / "esi" / "drive.xml").write_text(other)
    file, _ = written("cell", "--esi", str(tmp_path / "esi"))
    assert 'esi: "esi/drive.xml"' in file.read_text()
    assert 'pdos: {"2": [0x1600]}' in file.read_text()
    assert "bus0.axis.csp.Controlword" in variables(file)


def test_faults_of_other_files_are_shown(written, tmp_path):
    esi = tmp_path / "esi"
    esi.mkdir()
    (esi / "bad.xml").write_text("<EtherCATInfo><Vendor>")
    (esi / "drive.xml").write_bytes((CONFIG / "esi" / "drive.xml").read_bytes())
    _, shown = written("cell", "--esi", str(esi))
    assert f"{esi}/bad.xml:1: not XML that can be read" in shown


@pytest.mark.parametrize("name", ["readme.txt", "dictionary.xml"])
def test_folder_without_a_device_is_named_once(written, tmp_path, name):
    esi = tmp_path / "esi"
    esi.mkdir()
    (esi / name).write_text("<EtherCATDict/>")
    file, shown = written("cell", "--esi", str(esi))
    assert shown.count(f"{esi}: it describes no device; expected an ESI file with devices") == 1
    # Nothing about each slave: its EEPROM and objects are all that there is.
    assert "no description of" not in shown
    assert len(identities(file)) == 5


def test_modules_that_a_slave_detects_are_written(written, tmp_path):
    bus = tmp_path / "modular.yaml"
    bus.write_text(
        f"bus: m\nesi: {CONFIG / 'esi'}\nslaves:\n"
        "  - {name: ms, kind: esi, device: MS4, modules: [TEMP, null, RELAY, TEMP]}\n"
    )
    file, _ = written("modular", "--esi", str(CONFIG / "esi"), folder=tmp_path)
    assert "modules: [0x10, null, 0x20, 0x10]" in file.read_text()
    assert variables(file) == variables(bus)
    assert "bus0.ms.Temperature.Value_6030_01" in variables(file)


def test_existing_file_is_kept(written, tmp_path):
    (tmp_path / "found.yaml").write_text("mine")
    file, shown = written("coe", expected=2)
    assert "overwrite it with --force" in shown
    assert file.read_text() == "mine"
    written("coe", "--force")
    assert file.read_text() != "mine"


def test_options_belong_to_write(capsys):
    with pytest.raises(SystemExit) as end:
        main(["bus", "scan", *WHERE, "--force"], prog_name="eapctl")
    assert (end.value.code, "belong to --write" in capsys.readouterr().err) == (2, True)
