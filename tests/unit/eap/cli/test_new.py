"""``eapctl new``."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli.group import main


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
