"""``eapctl apply`` and ``rollback``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner
from msgspec.structs import replace

from eap.cli.group import main
from eap.config.new_plant import Shape, plant_text
from eap.errors import ControlError
from eap.ops.plant import load_or_raise
from tests.support.plantstub import PlantStub

CHANGE = "~ 0xF800:08 Configured objects: Device cycle time"


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(plant_text("ring", 3, Shape.RING))
    return path


@pytest.fixture
def stub(file, runtime):
    """Three stations that run slower than the file says."""
    with ExitStack() as stack:
        specs = [replace(spec, cycle_us=20_000) for spec in load_or_raise(file).stations]
        yield PlantStub("ring", specs, stack)


def run(*words):
    return CliRunner().invoke(main, list(map(str, words)))


def test_apply_and_back(stub, file):
    result = run("apply", file)
    assert result.exit_code == 0
    assert result.output.splitlines() == [
        *(
            line
            for number in (1, 2, 3)
            for line in (
                f"station-0{number} runs the new configuration: ok",
                f"  {CHANGE}  20000 -> 10000 us  ok",
            )
        ),
        "3 stations changed",
    ]
    assert run("apply", file).output == "no station changed\n"
    result = run("rollback", file, "--station", "station-02")
    assert result.output.splitlines() == [
        "station-02 runs the new configuration: ok",
        f"  {CHANGE}  10000 -> 20000 us  ok",
        "1 station changed, 2 unchanged",
    ]
    assert {spec.cycle_us for spec in stub.specs.values()} == {10_000, 20_000}


def test_json(stub, file):
    document = json.loads(run("apply", file, "--json").output)
    assert (document["ok"], document["refused"]) == (True, [])
    assert [step["station"] for step in document["steps"]] == [f"station-0{n}" for n in (1, 2, 3)]
    assert document["steps"][0]["results"][0]["ok"] is True
    document = json.loads(run("rollback", file, "--json").output)
    assert [step["why"] for step in document["steps"]] == ["runs the new configuration"] * 3


def test_refusal_in_the_middle(stub, file):
    stub.refuses = lambda spec: spec.name == "station-02"
    result = run("apply", file)
    assert result.exit_code == 1
    assert result.output.splitlines()[2:] == [
        "station-02 runs the new configuration: refused",
        f"  {CHANGE}  20000 -> 10000 us  not today",
        "  ! not today",
        "1 station changed, 2 unchanged",
        "station-02 refused: changed so far: station-01",
        "'eapctl apply' continues, 'eapctl rollback' restores the previous state",
    ]
    assert stub.specs["station-03"].cycle_us == 20_000
    result = run("apply", file, "--keep-going")
    assert result.exit_code == 1
    assert stub.specs["station-03"].cycle_us == 10_000


def test_impossible_change_changes_no_station(stub, file):
    stub.unable = {"station-02"}
    result = run("apply", file)
    assert result.exit_code == 1
    assert result.output.splitlines() == [
        "station-02 cannot change while it runs",
        "  ! port eap0 would be new",
        "no station changed",
    ]
    result = run("apply", file, "--keep-going", "--json")
    assert result.exit_code == 1
    document = json.loads(result.output)
    assert document["refused"] == [{"station": "station-02", "refused": ["port eap0 would be new"]}]
    assert stub.specs["station-02"].cycle_us == 20_000
    assert stub.specs["station-03"].cycle_us == 10_000


def test_nothing_to_roll_back(stub, file):
    assert run("rollback", file).output == "no station changed\n"


def test_apply_reports_an_appliance_that_ends(stub, file):
    def refuse(spec):
        if spec.name == "station-02":
            raise ControlError("appliance ring does not answer")
        return False

    stub.refuses = refuse
    result = run("apply", file)
    assert (result.exit_code, result.stderr) == (1, "appliance ring does not answer\n")
    assert result.output.splitlines()[2:5] == [
        "1 station changed, 2 unchanged",
        "interrupted: changed so far: station-01",
        "'eapctl apply' continues, 'eapctl rollback' restores the previous state",
    ]
    result = run("apply", file, "--json")
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert (document["ok"], document["error"]) == (False, "appliance ring does not answer")
