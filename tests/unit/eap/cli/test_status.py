from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli import main
from tests.unit.eap.cli.conftest import Appliance

pytestmark = pytest.mark.net


def test_status_of_one_appliance(appliance: Appliance) -> None:
    result = CliRunner().invoke(main, ["status", "--json"])
    assert result.exit_code == 0, result.stderr
    status = json.loads(result.stdout)
    assert status["version"] == 1
    assert set(status["processes"]) == {"supervisor", "engine", "services"}
    assert status["processes"]["engine"]["restarts"] == 2
    assert [s["name"] for s in status["stations"]] == ["mixer", "filler"]
    mixer = status["stations"][0]
    assert {"name", "net_id", "state", "ports", "discarded", "pd"} <= set(mixer)
    left, other = mixer["pd"]["rx"]
    assert (left["received"], left["lost"], left["quality"]) == (5, 0, 300)
    assert (other["received"], other["lost"], other["quality"]) == (0, None, None)


def test_status_merges_appliances(other_appliance: Appliance) -> None:
    status = json.loads(CliRunner().invoke(main, ["status", "--json"]).stdout)
    assert [s["name"] for s in status["stations"]] == ["oven", "mixer", "mixer", "filler"]
    assert [(a["plant"], a["stations"]) for a in status["appliances"]] == [
        ("hall", ["oven", "mixer"]),
        ("line", ["mixer", "filler"]),
    ]


@pytest.mark.parametrize(
    ("options", "stations"),
    [
        (["--plant", "hall"], ["oven", "mixer"]),
        (["--station", "filler"], ["filler"]),
        (["--station", "mixer"], ["mixer", "mixer"]),
        (["--station", "mixer", "--plant", "line"], ["mixer"]),
    ],
)
def test_status_of_the_chosen(
    other_appliance: Appliance, options: list[str], stations: list[str]
) -> None:
    status = json.loads(CliRunner().invoke(main, ["status", "--json", *options]).stdout)
    assert [s["name"] for s in status["stations"]] == stations


def test_status_for_people(appliance: Appliance) -> None:
    result = CliRunner().invoke(main, ["status"])
    assert result.exit_code == 0, result.stderr
    assert "Plant line" in result.stdout
    assert "mixer" in result.stdout


def test_unknown_plant_names_those_that_run(appliance: Appliance) -> None:
    result = CliRunner().invoke(main, ["status", "--plant", "lime"])
    assert result.exit_code == 1
    assert result.stderr == "no plant lime runs: running are line (mixer, filler)\n"
