"""Commands for recordings: their output and their exit codes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from click.testing import CliRunner, Result

from eap.cli.group import main
from tests.support.recordings import begin_values, write_frames, write_values


def run(*args: object) -> Result:
    return CliRunner().invoke(main, [str(each) for each in args], prog_name="eapctl")


def test_record_info_prints_the_contract(tmp_path: Path) -> None:
    result = run("record", "info", write_values(tmp_path / "a.mcap"), "--json")
    found = json.loads(result.stdout)
    assert result.exit_code == 0
    assert {"kind", "from", "until", "messages", "lost", "variables"} <= found.keys()
    assert (found["kind"], found["messages"], found["lost"]) == ("values", 450, 4)
    assert found["from"] == "2023-11-14T22:13:20.000000000Z"


def test_record_info_shows_facts_variables_and_events(tmp_path: Path) -> None:
    text = run("record", "info", write_frames(tmp_path / "a.pcapng")).stdout
    for part in (
        "frames of mill",
        "600 frames, 7 lost",
        "ports: island-02/eap0, island-01/eap0",
        "inside: mill.yaml",
        "island-01/temp   REAL  °C",
        "mark  door open",
    ):
        assert part in text


def test_killed_recording_is_described_and_repaired(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    writer = begin_values(path, 300)
    assert "being recorded" in run("record", "info", path).stdout
    refused = run("record", "repair", path)
    assert "stop the recording first" in refused.stderr
    shutil.copy(path, cut)
    writer.close()
    assert "unfinished" in run("record", "info", cut).stdout
    assert run("record", "repair", cut).exit_code == 0
    assert "unfinished" not in run("record", "info", cut).stdout


def test_record_info_of_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_text("text")
    assert "neither a recording of values" in run("record", "info", path).stderr
