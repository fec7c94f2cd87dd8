from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from tests.support.pages import ROOT

LINE = str(ROOT / "docs" / "examples" / "Line.tsproj")
PEER = "--peer", "panel", "--address", "127.0.9.{n}"


def run(*words: str) -> Result:
    return CliRunner().invoke(main, words)


@pytest.fixture
def plant(tmp_path: Path) -> str:
    path = str(tmp_path / "line.yaml")
    assert run("import", LINE, *PEER, "-o", path).exit_code == 0
    return path


def test_import_reports_what_it_took_and_writes_a_plant(tmp_path: Path) -> None:
    path = tmp_path / "line.yaml"
    result = run("import", LINE, *PEER, "-o", str(path))
    assert result.exit_code == 0
    assert "taken" in result.stdout
    assert "left     Device 2 (EtherCAT)" in result.stdout
    assert result.stdout.endswith(f"{path}: plant line, 2 stations (Line, panel)\n")
    assert run("check", str(path)).exit_code == 0


def test_import_without_a_plant_file_writes_nothing(tmp_path: Path) -> None:
    result = run("import", LINE)
    assert result.exit_code == 0
    assert "nothing was written: name a plant file with -o" in result.stdout


def test_import_to_stdout_prints_the_plant_only() -> None:
    result = run("import", LINE, *PEER, "-o", "-")
    assert result.exit_code == 0
    assert result.stdout.startswith("# Made by 'eapctl import Line.tsproj'.\nplant: Line\n")
    assert run("import", LINE, "--json", "-o", "-").exit_code == 2


def test_import_json_has_notes_and_findings(tmp_path: Path) -> None:
    broken = tmp_path / "b.tsproj"
    broken.write_text("<TcSmProject>")
    path = tmp_path / "line.yaml"
    result = run("import", LINE, str(broken), "-o", str(path), "--json")
    assert result.exit_code == 2
    document = json.loads(result.stdout)
    assert (document["ok"], document["file"]) == (False, "")
    assert [each["line"] for each in document["findings"]] == [1]
    assert {each["outcome"] for each in document["notes"]} == {"left", "taken"}
    assert not path.exists()


def test_import_shows_findings_with_file_and_line(tmp_path: Path) -> None:
    broken = tmp_path / "b.tsproj"
    broken.write_text("<TcSmProject>\n<x></y></TcSmProject>")
    result = run("import", str(broken), "-o", str(tmp_path / "x.yaml"))
    assert result.exit_code == 2
    assert f"{broken}:2: not XML that can be read: mismatched tag" in result.stderr
    assert "nothing was written" in result.stdout


def test_import_of_edc_says_why_it_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "node.edc"
    file.write_text("<X/>")
    result = run("import", str(file))
    assert result.exit_code == 2
    assert "EDC files have no public description" in result.stderr


def test_import_names_the_file_beside_a_plant_that_it_cannot_add_to(plant: str) -> None:
    result = run("import", LINE, *PEER, "-o", plant)
    assert result.exit_code == 0
    assert f"{plant} is as it was: " in result.stdout
    assert (
        "line-import.yaml: 2 stations (Line, panel) in a plant file of their own" in result.stdout
    )


def test_export_peer_shows_a_table_for_each_box(plant: str) -> None:
    result = run("export-peer", plant, "panel")
    assert result.exit_code == 0
    assert "EAP Line: publisher 'State' to UDP 127.0.9.2\n" in result.stdout
    assert "Speed     11        0  DINT      4  10 ms\n" in result.stdout


def test_export_peer_writes_files_and_names_them(plant: str, tmp_path: Path) -> None:
    file = tmp_path / "peer.xml"
    result = run("export-peer", plant, "panel", "-o", str(file))
    assert f"1 file written: {file}" in result.stdout
    again = run("export-peer", plant, "panel", "-o", str(file))
    assert (again.exit_code, "overwrite it with --force" in again.stderr) == (2, True)
    document = json.loads(run("export-peer", plant, "panel", "--json").stdout)
    assert document["station"] == "panel"
    assert [row["id"] for row in document["rows"]] == [11, 12, 13, 14, 15, 21, 22, 23, 24]
    imported = run("import", str(file), "--address", "127.0.9.{n}", "--json")
    assert json.loads(imported.stdout)["ok"]


def test_export_peer_makes_the_folder_that_is_named(plant: str, tmp_path: Path) -> None:
    folder = tmp_path / "items"
    result = run("export-peer", plant, "panel", "-o", f"{folder}/")
    assert "23 files written" in result.stdout
    assert len(list(folder.iterdir())) == 23
    again = run("import", *map(str, sorted(folder.iterdir())), "--address", "127.0.9.1")
    assert again.stdout.endswith(
        "1 station (EAP_Line); nothing was written: name a plant file with -o\n"
    )


def test_export_peer_to_stdout_prints_the_xml_only(plant: str, tmp_path: Path) -> None:
    result = run("export-peer", plant, "panel", "-o", "-")
    assert result.stdout.startswith("<")
    file = tmp_path / "peer.xml"
    file.write_text(result.stdout)
    assert run("import", str(file), "--address", "127.0.9.{n}").exit_code == 0
    assert run("export-peer", plant, "panel", "-o", "-", "--json").exit_code == 2


@pytest.mark.parametrize("station", ["Line", "panel"])
def test_exported_peers_are_imported_without_errors(
    plant: str, tmp_path: Path, station: str
) -> None:
    file, again = tmp_path / "peer.xml", tmp_path / "again.yaml"
    assert run("export-peer", plant, station, "-o", str(file)).exit_code == 0
    words = "--address", "127.0.8.{n}", "-o", str(again)
    assert run("import", str(file), *words).exit_code == 0
    assert run("check", str(again)).exit_code == 0


def test_export_peer_of_a_station_alone_says_so(tmp_path: Path) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(
        "plant: p\nstations:\n  - name: a\n    net_id: 1.1.1.1.1.1\n"
        '    ports: [{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 1.1.1.1.2.1}]\n'
    )
    assert run("export-peer", str(path), "a").stdout == "a exchanges no process data\n"
