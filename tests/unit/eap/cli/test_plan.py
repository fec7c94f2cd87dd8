"""``eapctl plan``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.config.new_plant import Shape, plant_text
from eap.ops.plant import load_or_raise
from tests.support.plantstub import PlantStub


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(plant_text("ring", 3, Shape.RING))
    return path


@pytest.fixture
def stub(file, runtime):
    with ExitStack() as stack:
        yield PlantStub("ring", load_or_raise(file).stations, stack)


def plan(*words):
    return CliRunner().invoke(main, ["plan", *map(str, words)])


def test_nothing_differs(stub, file):
    assert plan(file).output == "no differences: all 3 stations are as the file says\n"
    assert plan(file, "--station", "station-02").output == (
        "no differences: station-02 is as the file says\n"
    )
    assert json.loads(plan(file, "--json").output)["ok"] is True


def test_differences(stub, file):
    file.write_text(
        file.read_text().replace("name: station-02\n", "name: station-02\n    cycle_us: 5000\n")
    )
    assert plan(file).output.splitlines()[:3] == [
        "station-02",
        "  ~ 0xF800:08 Configured objects: Device cycle time  10000 -> 5000 us",
        "1 station of 3 to change (1 changed), 2 unchanged",
    ]
    document = json.loads(plan(file, "--json").output)
    assert document["ok"] is True
    assert [len(each["changes"]) for each in document["stations"]] == [0, 1, 0]
    assert {step["station"] for step in document["steps"]} >= {"station-02"}
    assert stub.taken == []


def test_impossible_change_is_refused(stub, file):
    stub.unable = {"station-03"}
    result = plan(file)
    assert result.exit_code == 1
    assert result.output.splitlines()[:2] == ["station-03", "  ! port eap0 would be new"]
    result = plan(file, "--json")
    assert (result.exit_code, json.loads(result.output)["ok"]) == (1, False)


def test_no_plant(stub, file):
    result = plan(file, "--station", "station-2")
    assert result.exit_code == 2
    assert "did you mean station-02?" in result.stderr
    file.write_text("plant: 1")
    assert plan(file).exit_code == 2


def test_plan_names_absent_stations(file, runtime):
    specs = load_or_raise(file).stations
    with ExitStack() as stack:
        PlantStub("ring", specs[1:], stack)
        assert plan(file).output.splitlines() == [
            "no differences: all 2 stations are as the file says",
            "not running here: station-01; start them with:",
            f"  eapctl run {file} --station station-01",
        ]
        refused = plan(file, "--station", "station-01")
        assert refused.exit_code == 2
        assert refused.stderr.endswith(f"start it with 'eapctl run {file} --station station-01'\n")
        assert json.loads(plan(file, "--json").output)["absent"] == ["station-01"]
        assert json.loads(plan(file, "--json", "--station", "station-02").output)["absent"] == []
