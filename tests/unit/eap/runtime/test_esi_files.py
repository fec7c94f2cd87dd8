"""ESI files on disk: folders, the cache of their lists, and files with faults."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from devicebus.esi.choice import DeviceQuery
from eap.runtime import esi_files
from eap.runtime.esi_files import EsiSource

ESI = Path(__file__).parents[4] / "config" / "esi"
DO4 = 0x07D4_3052


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "esi"
    (made / "sub").mkdir(parents=True)
    (made / "terminals.XML").write_bytes((ESI / "terminals.xml").read_bytes())
    (made / "sub" / "drive.xml").write_bytes((ESI / "drive.xml").read_bytes())
    return made


@pytest.fixture
def reads(monkeypatch):
    """Names of the files that are read for their list."""
    found = []
    original = esi_files.list_devices

    def list_devices(stream):
        found.append(Path(stream.name).name)
        return original(stream)

    monkeypatch.setattr(esi_files, "list_devices", list_devices)
    return found


def types(source):
    return [each.listed.type for each in source.devices]


def test_folder_has_the_devices_of_all_files(folder):
    assert types(EsiSource(folder)) == ["SD1", "C100", "DO4", "DO4", "DI4", "AI2"]


def test_list_is_kept_until_a_file_changes(folder, reads):
    EsiSource(folder)
    assert sorted(reads) == ["drive.xml", "terminals.XML"]
    reads.clear()
    assert len(EsiSource(folder).devices) == 6
    assert reads == []
    os.utime(folder / "terminals.XML", ns=(1, 1))
    (folder / "new.xml").write_bytes((ESI / "drive.xml").read_bytes())
    (folder / "sub" / "drive.xml").unlink()
    assert types(EsiSource(folder)) == ["SD1", "C100", "DO4", "DO4", "DI4", "AI2"]
    assert sorted(reads) == ["new.xml", "terminals.XML"]


def test_damaged_cache_is_made_again(folder, reads, state):
    EsiSource(folder)
    (cache,) = (state / "esi").iterdir()
    cache.write_bytes(cache.read_bytes()[:-40])
    reads.clear()
    assert len(EsiSource(folder).devices) == 6
    assert len(reads) == 2


def test_cache_that_cannot_be_written_is_no_failure(folder, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", "/proc/nowhere")
    assert len(EsiSource(folder).devices) == 6


def test_bad_file_of_a_folder_is_a_finding(folder):
    good = (folder / "terminals.XML").read_text()
    (folder / "bad.xml").write_text(good[:3000])
    (folder / "dictionary.xml").write_text("<EtherCATDict/>")
    (folder / "note.txt").write_text("no XML")
    os.mkfifo(folder / "pipe.xml")
    source = EsiSource(folder)
    assert len(source.devices) >= 6
    (finding,) = source.findings()
    assert finding.file == str(folder / "bad.xml")
    assert finding.line > 0
    assert "not XML that can be read" in finding.message


def test_device_is_chosen_by_type_and_revision(folder):
    source = EsiSource(folder)
    assert source.choose(DeviceQuery(type="do4")).device.revision == 0x0012_0000
    device = source.choose(DeviceQuery(product=DO4, revision=0x0010_0000)).device
    assert (device.revision, len(device.pdos)) == (0x0010_0000, 2)


def test_description_that_cannot_be_used_gives_way_to_an_older_one(folder):
    old = (folder / "terminals.XML").read_text().replace("#x00120000", "#x270B0000")
    (folder / "old.xml").write_text(old.replace('Sm="0"', 'Sm="9"'))
    source = EsiSource(folder)
    assert source.choose(DeviceQuery(type="DO4")).device.revision == 0x0012_0000
    asked = source.choose(DeviceQuery(type="DO4", revision=0x270B_0000))
    assert asked.device is None
    assert "sync manager 9" in asked.findings[0].message


def test_slave_is_matched_with_an_older_description(folder):
    source = EsiSource(folder)
    found = source.match(DeviceQuery(0xE5A, DO4, "", 0x0011_0000))
    assert found.device.revision == 0x0010_0000
    assert source.match(DeviceQuery(0xE5A, 0x99, "", 0x0011_0000)) is None


def test_unknown_device_names_faults_of_the_folder(folder):
    (folder / "bad.xml").write_text("<EtherCATInfo>")
    with pytest.raises(
        ValueError,
        match=r"esi: none of 6 devices is EL1; known: SD1, C100, .* \(1 of its files has faults\)",
    ):
        EsiSource(folder).choose(DeviceQuery(type="EL1"))


def test_file_that_is_gone_is_a_finding(folder):
    source = EsiSource(folder)
    (folder / "sub" / "drive.xml").unlink()
    (finding,) = source.choose(DeviceQuery(type="SD1")).findings
    assert "it cannot be read: No such file" in finding.message


@pytest.mark.parametrize("name", ["missing.xml", "pipe"])
def test_source_that_is_no_file_is_refused(tmp_path, name):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match=r"does not exist|is no regular file"):
        EsiSource(tmp_path / name)
