from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import main

pytestmark = pytest.mark.net  # the runtime directory is claimed

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 1.1.1.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 1.1.1.1.2.1}
"""


def test_wrong_plant_is_reported_as_check_does(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT.replace("kind: eap", "kind: epa").replace("plant:", "plnt:"))
    checked = CliRunner().invoke(main, ["check", str(path)])
    result = CliRunner().invoke(main, ["run", str(path)])
    assert (result.exit_code, result.stdout) == (2, "")
    lines = result.stderr.splitlines()
    assert lines == checked.stderr.splitlines()[: len(lines)]
    assert len(lines) >= 2
    assert lines[0].startswith(f"{path}:1: ")


def test_unknown_station_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    result = CliRunner().invoke(main, ["run", str(path), "--station", "mixr"])
    assert result.exit_code == 2
    assert result.stderr == "plant line has no station 'mixr', did you mean mixer?\n"


def test_runtime_directory_that_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT)
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(path / "run"))
    result = CliRunner().invoke(main, ["run", str(path)])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"runtime directory {path / 'run' / 'line'}: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("option", [["--priority", "100"], ["--cpu", "-1"]])
def test_options_out_of_range(option: list[str]) -> None:
    result = CliRunner().invoke(main, ["run", "plant.yaml", *option])
    assert result.exit_code == 2
    assert f"Invalid value for '{option[0]}'" in result.stderr


BLANK = ["--blank", "mixer", "--interface", "udp://127.9.7.1", "--net-id", "127.9.7.1.2.1"]


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "nothing to run: give PLANT, or --blank NAME"),
        (["plant.yaml", *BLANK], "excludes PLANT"),
        ([*BLANK, "--station", "mixer"], "excludes PLANT and --station"),
        (BLANK[:4], "needs --interface URI and --net-id N"),
        (["plant.yaml", "--cycle", "5"], "need --blank NAME"),
        (["plant.yaml", "--resume"], "need --blank NAME"),
        ([*BLANK, "--cycle", "0"], "0.1 to 60000 milliseconds"),
    ],
)
def test_blank_and_plant_are_two_forms(words: list[str], reason: str) -> None:
    result = CliRunner().invoke(main, ["run", *words])
    assert (result.exit_code, result.stdout) == (2, "")
    assert reason in result.stderr


def test_findings_of_a_blank_station_name_the_options() -> None:
    words = ["--blank", "a/b", "--interface", "upd://127.9.7.1", "--net-id", "127.9"]
    result = CliRunner().invoke(main, ["run", *words])
    assert (result.exit_code, result.stdout) == (2, "")
    assert sorted(line.partition(":")[0] for line in result.stderr.splitlines()) == [
        "--blank",
        "--interface",
        "--net-id",
    ]
