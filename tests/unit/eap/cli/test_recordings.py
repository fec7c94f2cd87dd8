"""Commands for recordings: their output and their exit codes."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from eap.recording.frames_writer import FramesWriter
from eap.recording.header import RecordingHeader
from tests.support.recordings import T0, begin_values, write_frames, write_values


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


def test_plot_fits_the_terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("LINES", "24")
    path = write_values(tmp_path / "a.mcap")
    lines = run("plot", path, "island-01/temp", "island-01/axis.on").stdout.splitlines()
    assert len(lines) <= 23
    assert max(map(len, lines)) <= 80
    assert lines[0].split() == ["°C", "island-01/temp", "99.6667"]
    assert any("⠤" in line or "⠔" in line or "⡠" in line for line in lines)
    assert "22:13:20" in lines[-1] or ":13:2" in lines[-1]


def test_plot_writes_a_picture(tmp_path: Path) -> None:
    path = write_values(tmp_path / "a.mcap")
    result = run("plot", path, "temp", "--with", path, "--out", tmp_path / "x.svg")
    assert (result.exit_code, result.stdout) == (0, "")
    assert "4 lines" in result.stderr
    assert (tmp_path / "x.svg").read_text().startswith("<svg")


def test_export_prints_rows_and_columns(tmp_path: Path) -> None:
    path = write_frames(tmp_path / "a.pcapng")
    result = run("export", path, "--csv", "--json", "island-01/count")
    assert json.loads(result.stdout) == {
        "file": str(tmp_path / "a.csv"), "form": "csv", "rows": 300, "columns": 1,
            "damaged_chunks": 0,
    }  # fmt: skip
    lines = run("export", path, "--csv", "-o", "-", "island-01/b", "--until", "+10ms").stdout
    assert lines.splitlines()[0] == "time_ns,island-01/b"
    assert len(lines.splitlines()) == 3
    assert "expected a form" in run("export", path).stderr


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["record", "info", "a.mcap"], "a.mcap: No such file or directory"),
        (["plot", "a.mcap", "temp"], "a.mcap: No such file or directory"),
        (["plot", "logs/a", "temp"], "logs/a: No such file or directory"),
        (["record", "start", "-o", ""], "-o: a name is missing"),
    ],
)
def test_wrong_paths_are_named(words: list[str], problem: str) -> None:
    assert problem in run(*words).stderr


def test_export_to_a_full_disk_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("eap.ops.recordings.write_csv", fail)
    result = run("export", write_values(tmp_path / "a.mcap"), "--csv", "-o", tmp_path / "x.csv")
    assert result.stderr == f"{tmp_path}/x.csv: No space left on device\n"
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


def test_replay_of_a_capture_needs_a_plant(tmp_path: Path) -> None:
    writer = FramesWriter(tmp_path / "a.pcapng", RecordingHeader(plant="", host="", started_ns=T0))
    writer.close(T0)
    result = run("replay", tmp_path / "a.pcapng", "--dry-run")
    assert (result.exit_code, "name its file with --plant" in result.stderr) == (2, True)
