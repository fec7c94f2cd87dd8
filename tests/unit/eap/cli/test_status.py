from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import main
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


def test_status_prints_tables(appliance: Appliance) -> None:
    result = CliRunner().invoke(main, ["status"])
    assert result.exit_code == 0, result.stderr
    assert result.stdout.startswith("line: ")
    assert "mixer" in result.stdout
    full = CliRunner().invoke(main, ["status", "--full"]).stdout
    assert full.startswith("line: ")
    assert "Process of line" in full


def test_unknown_plant_names_those_that_run(appliance: Appliance) -> None:
    result = CliRunner().invoke(main, ["status", "--plant", "lime"])
    assert result.exit_code == 1
    assert result.stderr == "no plant lime runs; running: line (mixer, filler)\n"


def interrupted_after(
    monkeypatch: pytest.MonkeyPatch, looks: int, between: Callable[[int], None] = lambda _: None
) -> None:
    """Let ``status --watch`` be interrupted, as by Ctrl-C, after so many looks."""
    pauses = itertools.count(1)

    def pause(*_: object) -> None:
        number = next(pauses)
        between(number)
        if number == looks:
            raise KeyboardInterrupt

    monkeypatch.setattr("eap.cli.status._pause", pause)


def test_watch_prints_blocks_when_piped_until_it_is_interrupted(
    appliance: Appliance, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted_after(monkeypatch, 2)
    result = CliRunner().invoke(main, ["status", "--watch", "--interval", "0.5"])
    assert (result.exit_code, result.stderr) == (0, "")
    nothing, first, second = result.stdout.split(", every 0.5 s\n")
    assert len(nothing) == len("12:34:56")
    assert "Tx " in first
    assert "Tx/s" in second
    assert "\x1b" not in result.stdout


def test_status_watch_continues_without_an_appliance(
    runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as stack:

        def start(number: int) -> None:
            if number == 1:
                Appliance("line", ["mixer"], stack).wait_served()

        interrupted_after(monkeypatch, 2, start)
        result = CliRunner().invoke(main, ["status", "--watch"])
    assert result.exit_code == 0
    assert "no appliance runs: start one with 'eapctl run PLANT'" in result.stdout
    assert result.stdout.index("waiting for an appliance") < result.stdout.index("line: ")


def test_watch_for_programs_prints_an_object_a_line(
    appliance: Appliance, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted_after(monkeypatch, 3)
    result = CliRunner().invoke(main, ["status", "--watch", "--json", "--plant", "line"])
    assert [json.loads(line)["version"] for line in result.stdout.splitlines()] == [1, 1, 1]


def test_findings_are_in_the_document(appliance: Appliance) -> None:
    status = json.loads(CliRunner().invoke(main, ["status", "--json"]).stdout)
    assert {
        "severity": "error", "where": "line services", "what": "not running",
        "advice": "it is being restarted", "since": None, "plant": "line",
    } in status["findings"]  # fmt: skip
