from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from tests.unit.eap.cli.conftest import Appliance

pytestmark = pytest.mark.net


def invoke(*words: str) -> Result:
    return CliRunner().invoke(main, ["pd", *words])


def lines(result: Result) -> list[dict[str, object]]:
    assert result.exit_code == 0, result.stderr
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_list_names_every_pd_and_variable(appliance: Appliance) -> None:
    rows = lines(invoke("list", "--station", "mixer", "--json"))
    assert [(row["direction"], row["name"]) for row in rows] == [
        ("tx", "state"),
        ("rx", "left"),
        ("rx", "other"),
        (None, None),
    ]
    sent = rows[0]
    assert sent["variables"] == [
        {"name": "ticks", "type": "UDINT", "unit": "", "writer": "engine"},
        {"name": "setpoint", "type": "INT", "unit": "1/min", "writer": "application"},
    ]
    del sent["variables"]
    assert sent == {
        "station": "mixer",
        "direction": "tx",
        "name": "state",
        "id": 101,
        "version": 3,
        "length": 6,
        "port": "eap0",
        "poll": None,
        "publisher": "1.1.1.1.2.1",
        "frame": "to-right",
        "destination": "239.1.2.3",
    }
    assert [v["name"] for v in rows[3]["variables"]] == [  # type: ignore[attr-defined]
        "curve",
        "to-right.FrameCtrl",
        "state.VarCtrl",
    ]


def test_list_merges_all_appliances(other_appliance: Appliance) -> None:
    stations = {row["station"] for row in lines(invoke("list", "--json"))}
    assert stations == {"mixer", "filler", "oven"}
    stations = {row["station"] for row in lines(invoke("list", "--plant", "hall", "--json"))}
    assert stations == {"oven", "mixer"}


def test_list_prints_a_table(appliance: Appliance) -> None:
    result = invoke("list")
    rows = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert rows[2] == "mixer"
    assert "→ state 101 3 eap0 239.1.2.3 ticks UDINT engine" in rows
    assert "← other 103 0 eap0 any publisher silent INT engine" in rows
    assert "setpoint INT 1/min application" in rows


def test_watch_prints_present_values_first(appliance: Appliance) -> None:
    appliance.set("mixer", "level", -4)
    (change,) = lines(invoke("watch", "mixer", "level", "--count", "1", "--json"))
    assert change.pop("time")
    assert change == {
        "station": "mixer",
        "variable": "level",
        "value": -4,
        "cycle": 1000,
        "quality": 300,
    }


def test_watch_of_all_variables_has_quality_only_for_received_ones(appliance: Appliance) -> None:
    changes = lines(invoke("watch", "mixer", "--count", "7", "--json"))
    quality = {c["variable"]: c.get("quality", "none") for c in changes}
    assert quality["level"] == 300
    assert quality["silent"] is None
    assert quality["ticks"] == "none"
    assert len(quality) == 7


def test_watch_of_several_stations(appliance: Appliance) -> None:
    changes = lines(invoke("watch", "mixer/level", "filler/ticks", "--count", "2", "--json"))
    assert {(c["station"], c["variable"]) for c in changes} == {
        ("mixer", "level"),
        ("filler", "ticks"),
    }


def test_watch_prints_text_lines(appliance: Appliance) -> None:
    result = invoke("watch", "mixer", "level", "silent", "setpoint", "--count", "3")
    texts = sorted(line[14:] for line in result.stdout.splitlines())
    assert texts == [
        "mixer/level = 0  cycle 1000  quality 30.0 ms",
        "mixer/setpoint = 7  cycle 1000",
        "mixer/silent = 0  cycle 1000  quality never received",
    ]


def start_watch(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "eap", "pd", "watch", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_watch_follows_changes_until_interrupted(appliance: Appliance) -> None:
    with start_watch("mixer", "ticks", "--period", "10", "--json") as process:
        assert process.stdout
        assert json.loads(process.stdout.readline())["value"] == 0
        appliance.set("mixer", "ticks", 5)
        assert json.loads(process.stdout.readline())["value"] == 5
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")


@pytest.mark.parametrize("names", [["mixer/ticks"], ["mixer/ticks", "filler/ticks"]])
def test_watch_ends_with_the_appliance(appliance: Appliance, names: list[str]) -> None:
    with start_watch(*names, "--json") as process:
        assert process.stdout
        for _ in names:
            process.stdout.readline()
        appliance.stop()
        _, errors = process.communicate(timeout=20)
    assert process.returncode == 1
    assert errors.count("\n") == 1
    assert "appliance line (mixer, filler; process 1) does not answer" in errors


def test_reader_that_leaves_early_ends_a_command_quietly(appliance: Appliance) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "eap", "pd", "list"],
            stdout=writing,
            stderr=subprocess.PIPE,
            check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (0, b"")


def test_set_reads_the_value_by_its_type(appliance: Appliance) -> None:
    result = invoke("set", "mixer", "setpoint", "-0x10", "--json")
    assert lines(result) == [{"station": "mixer", "variable": "setpoint", "value": -16}]
    assert appliance.files["mixer"].image.read("setpoint") == -16
    result = invoke("set", "filler/curve", "[1, 2.5]")
    assert (result.exit_code, result.stdout) == (0, "filler/curve = [1, 2.5]\n")
    assert appliance.files["filler"].image.read("curve") == (1.0, 2.5)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["mixer", "setpoint", "warm"], "'warm' is not a value of INT"),
        (["mixer", "setpoint", "40000"], "from -32768 to 32767"),
        (["filler", "curve", "1,nan"], "expected a finite number"),
        (["mixer", "level", "1"], "is written by the engine"),
        (["mixer", "setpiont", "1"], "did you mean setpoint?"),
        (["mixr", "setpoint", "1"], "no station mixr runs"),
    ],
)
def test_refused_set_has_its_reason_in_one_line(
    appliance: Appliance, words: list[str], reason: str
) -> None:
    result = invoke("set", *words)
    assert result.exit_code == 1
    assert reason in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""


def test_watch_of_an_unknown_variable_is_refused(appliance: Appliance) -> None:
    result = invoke("watch", "mixer", "levl")
    assert result.exit_code == 1
    assert "did you mean level?" in result.stderr


def test_station_of_two_plants_must_be_chosen(other_appliance: Appliance) -> None:
    result = invoke("set", "mixer", "setpoint", "1")
    assert result.exit_code == 1
    assert "station mixer runs in hall, line: choose one with --plant" in result.stderr
    result = invoke("set", "mixer", "setpoint", "1", "--plant", "hall")
    assert result.exit_code == 0
    assert other_appliance.files["mixer"].image.read("setpoint") == 1


def test_nothing_runs(runtime: Path) -> None:
    result = invoke("list")
    assert result.exit_code == 1
    assert f"start one with 'eapctl run PLANT' (looked in {runtime})" in result.stderr
