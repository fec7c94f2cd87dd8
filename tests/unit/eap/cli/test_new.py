"""``eapctl new``."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.config.new_plant import example_names


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return lambda *words: CliRunner().invoke(main, ["new", *words])


def check(path):
    return CliRunner().invoke(main, ["check", str(path)])


def test_new_writes_a_ring_by_default(run, tmp_path):
    result = run("hall.yaml")
    assert result.output == "hall.yaml: plant hall, 3 stations in a ring; eapctl run hall.yaml\n"
    assert check(tmp_path / "hall.yaml").exit_code == 0
    assert "#   eapctl apply hall.yaml\n" in (tmp_path / "hall.yaml").read_text()


def test_a_star(run, tmp_path):
    words = ("--star", "--stations", "7", "--name", "line", "--address", "10.0.0.11")
    result = run("hall.yaml", *words, "--json")
    assert json.loads(result.stdout) == {
        "file": "hall.yaml",
        "plant": "line",
        "shape": "star",
        "stations": 7,
    }
    assert "7 stations, 12 PDs sent, 12 PDs received" in check(tmp_path / "hall.yaml").output


def test_stdout(run, tmp_path):
    result = run("-", "--cycle", "0.5")
    assert "defaults: {cycle_us: 500}\n" in result.stdout
    assert "plant: plant\n" in result.stdout
    assert run("-", "--json").exit_code == 2
    assert not list(tmp_path.iterdir())


def test_new_keeps_an_existing_file_without_force(run, tmp_path):
    (tmp_path / "hall.yaml").write_text("mine")
    result = run("hall.yaml")
    assert (result.exit_code, result.stderr) == (
        2,
        "hall.yaml exists: overwrite it with --force\n",
    )
    assert (tmp_path / "hall.yaml").read_text() == "mine"
    assert run("hall.yaml", "--force").exit_code == 0
    assert check(tmp_path / "hall.yaml").exit_code == 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ((), "Missing argument 'FILE'"),
        (("a.yaml", "--stations", "1"), "2<=x<=250"),
        (("a.yaml", "--cycle", "0.01"), "0.1 to 60000 milliseconds"),
        (("a.yaml", "--cycle", "0.1234"), "0.1 to 60000 milliseconds"),
        (("a.yaml", "--cycle", "fast"), "0.1 to 60000 milliseconds"),
        (("a.yaml", "--address", "300.1.1.1"), "is not an IPv4 address"),
        (("a.yaml", "--name", "a b"), "plant name 'a b'"),
    ],
)
def test_impossible_change_has_its_reason(run, tmp_path, words, reason):
    result = run(*words)
    assert result.exit_code == 2
    assert reason in result.stderr
    assert not list(tmp_path.iterdir())


def test_file_name_with_a_space_becomes_a_plant_name_without(run, tmp_path):
    assert run("my plant.yaml").exit_code == 0
    assert check(tmp_path / "my plant.yaml").exit_code == 0


def test_folder_that_is_not_there(run):
    result = run("nowhere/hall.yaml")
    assert result.exit_code == 2
    assert "nowhere/hall.yaml cannot be written: no folder nowhere" in result.stderr


@pytest.mark.parametrize("example", example_names())
def test_example_is_a_plant_in_any_folder(run, tmp_path, example):
    result = run("hall.yaml", "--from", example)
    assert result.exit_code == 0, result.stderr
    assert result.output.startswith(f"hall.yaml: plant hall, a copy of the example {example}")
    checked = check(tmp_path / "hall.yaml")
    assert (checked.exit_code, checked.stderr) == (0, "")
    text = (tmp_path / "hall.yaml").read_text()
    assert text.startswith("# yaml-language-server: $schema=file:///")
    assert "config/" not in text.partition("\n")[2]


def test_example_comes_with_its_files_in_the_folder_of_the_plant(run, tmp_path):
    (tmp_path / "line").mkdir()
    result = run("line/demo.yaml", "--from", "demo", "--name", "north", "--json")
    assert json.loads(result.stdout) == {
        "file": "line/demo.yaml",
        "plant": "north",
        "example": "demo",
        "files": [
            *(f"line/buses/{name}" for name in ("drive.yaml", "coe.yaml", "io.yaml", "level.csv")),
        ],
    }
    assert check(tmp_path / "line/demo.yaml").exit_code == 0
    again = run("line/other.yaml", "--from", "demo")
    assert again.exit_code == 0, "files with the same content stay"


def test_example_overwrites_nothing_without_force(run, tmp_path):
    (tmp_path / "buses").mkdir()
    mine = tmp_path / "buses/drive.yaml"
    mine.write_text("mine")
    result = run("hall.yaml", "--from", "demo")
    assert (result.exit_code, result.stderr) == (
        2,
        "buses/drive.yaml exists: overwrite it with --force\n",
    )
    assert list(tmp_path.rglob("*.*")) == [mine]
    assert run("hall.yaml", "--from", "demo", "--force").exit_code == 0
    assert check(tmp_path / "hall.yaml").exit_code == 0


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--from", "valves"), "unknown example 'valves', did you mean valve?"),
        (("--from", "zz"), "known examples: cell, demo, "),
        (("--from", "../demo"), "unknown example"),
        (("--from", "demo", "--star"), "omit --stations"),
        (("--from", "demo", "--name", "a b"), "plant name 'a b'"),
    ],
)
def test_impossible_example_has_its_reason(run, tmp_path, words, reason):
    result = run("hall.yaml", *words)
    assert result.exit_code == 2
    assert reason in result.stderr
    assert not list(tmp_path.iterdir())
