from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.config.new_plant import SCHEMA

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 1.1.1.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 1.1.1.1.2.1}
    variables: {speed: INT}
    frames:
      - {name: out, port: eap0, to: 239.1.2.3}
    publish:
      - {name: state, frame: out, id: 7, variables: [speed]}
"""


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    return path


def break_plant(path: Path) -> None:
    path.write_text(PLANT.replace("speed: INT", "speed: INTT").replace("id: 7", "id: -7"))


def test_a_plant_that_is_well(plant: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(plant)])
    assert result.exit_code == 0, result.stderr
    assert result.stdout == (
        f"{plant}: no errors (plant line: 1 station, 1 PD sent, 0 PDs received)\n"
    )
    result = CliRunner().invoke(main, ["check", str(plant), "--json"])
    assert (result.exit_code, result.stdout) == (0, '{"ok":true,"findings":[],"warnings":[]}\n')
    plant.write_text(PLANT.replace("[speed]", f"[{', '.join(['speed'] * 255)}]"))
    result = CliRunner().invoke(main, ["check", str(plant)])
    assert (result.exit_code, result.stdout.count("\n"), result.stderr.count("\n")) == (0, 1, 1)
    assert result.stderr.startswith(f"warning: {plant}:3: station mixer, port eap0: 0x")
    result = CliRunner().invoke(main, ["check", str(plant), "--json"])
    assert (result.exit_code, result.stderr) == (0, "")
    assert [each["line"] for each in json.loads(result.stdout)["warnings"]] == [3]


def test_all_findings_at_once(plant: Path) -> None:
    break_plant(plant)
    result = CliRunner().invoke(main, ["check", str(plant)])
    assert (result.exit_code, result.stdout) == (2, "")
    first, second, total = result.stderr.splitlines()
    assert first.startswith(f"{plant}:7: ")
    assert second.startswith(f"{plant}:11: ")
    assert "; expected " in first
    assert total == f"{plant}: 2 errors: the plant cannot run; correct the file"


def test_findings_for_programs(plant: Path) -> None:
    break_plant(plant)
    result = CliRunner().invoke(main, ["check", str(plant), "--json"])
    assert (result.exit_code, result.stderr) == (2, "")
    answer = json.loads(result.stdout)
    assert answer["ok"] is False
    assert [finding["line"] for finding in answer["findings"]] == [7, 11]
    keys = {"file", "line", "path", "message", "expected"}
    assert all(set(finding) == keys for finding in answer["findings"])


BUS = """\
bus: small
slaves:
  - {name: a, kind: coupler}
  - {name: b, kind: analogue, inputs: [{name: level, type: INT}]}
"""


def test_check_of_a_bus_file(tmp_path: Path) -> None:
    path = tmp_path / "bus.yaml"
    path.write_text(BUS)
    result = CliRunner().invoke(main, ["check", str(path)])
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{path}: no errors (bus small: 2 slaves)\n"
    path.write_text(BUS.replace("coupler", "couple").replace("type: INT", "bits: x"))
    result = CliRunner().invoke(main, ["check", str(path)])
    assert (result.exit_code, result.stdout) == (2, "")
    first, second, total = result.stderr.splitlines()
    assert first.startswith(f"{path}:3: kind is 'couple'")
    assert second.startswith(f"{path}:4: bits is 'x'")
    assert total == f"{path}: 2 errors: the bus cannot run; correct the file"


@pytest.mark.parametrize("command", [["run"], ["plan"]])
def test_bus_file_in_place_of_a_plant_is_one_finding(tmp_path: Path, command: list[str]) -> None:
    path = tmp_path / "bus.yaml"
    path.write_text(BUS)
    result = CliRunner().invoke(main, [*command, str(path)])
    expected = "expected a plant file; 'eapctl sim run' runs a bus file"
    assert (result.exit_code, result.stderr) == (2, f"{path}: it is a bus file; {expected}\n")


def test_a_directory_is_a_finding_too(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(tmp_path), "--json"])
    assert result.exit_code == 2
    assert [f["message"] for f in json.loads(result.stdout)["findings"]] == ["is a directory"]


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["check", str(tmp_path / "none.yaml")])
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "does not exist" in result.stderr


def test_schema_is_printed_as_published() -> None:
    result = CliRunner().invoke(main, ["check", "--schema"])
    assert (result.exit_code, result.stdout) == (0, SCHEMA.read_text())


@pytest.mark.parametrize(("words", "reason"), [((), "give FILE"), (("--schema", "a"), "excludes")])
def test_check_without_a_task_names_it(words: tuple[str, ...], reason: str) -> None:
    result = CliRunner().invoke(main, ["check", *words])
    assert result.exit_code == 2
    assert reason in result.stderr
