"""The commands against plants that run: what docs/commands.md shows, and the contract."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import (
    EAPCTL,
    Appliance,
    plants,
    run_eapctl,
    spawn_eapctl,
    wait_until,
)
from tests.support.machine import slowness

pytestmark = pytest.mark.net

DEMO = Path("config/demo.yaml").absolute()
HALVES = """\
plant: halves
stations:
  - name: one
    net_id: 127.9.6.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.6.1", net_id: 127.9.6.1.2.1}
  - name: two
    net_id: 127.9.6.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.6.2", net_id: 127.9.6.2.2.1}
"""
ISLANDS = ["island-01", "island-02", "island-03"]


@pytest.fixture(scope="module")
def demo() -> Iterator[Appliance]:
    with plants() as folder:
        appliance = folder.start(DEMO)
        assert appliance.wait_ready() == ISLANDS
        wait_until(lambda: appliance.rx("island-02", "left-state")["received"] > 5)
        yield appliance


def run(appliance: Appliance, *words: str) -> subprocess.CompletedProcess[str]:
    return run_eapctl(appliance.runtime, *words)


@contextmanager
def watching(appliance: Appliance, *words: str) -> Iterator[subprocess.Popen[str]]:
    environment = os.environ | {"EAP_RUNTIME_DIR": str(appliance.runtime)}
    command = [*EAPCTL, "pd", "watch", *words, "--json"]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        yield process


def next_change(process: subprocess.Popen[str]) -> dict[str, Any]:
    assert process.stdout is not None
    return dict(json.loads(process.stdout.readline()))


def test_a_value_set_here_arrives_there(demo: Appliance) -> None:
    with watching(demo, "island-02", "left_setpoint", "--period", "10") as process:
        before = next_change(process)
        value = before["value"] + 1
        assert run(demo, "pd", "set", "island-01", "setpoint", str(value)).returncode == 0
        after = next_change(process)
        assert set(after) == {"station", "variable", "value", "time", "cycle", "quality"}
        assert (after["station"], after["variable"]) == ("island-02", "left_setpoint")
        assert after["value"] == value
        assert after["cycle"] > before["cycle"]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0


def test_watch_of_stations_in_one_stream(demo: Appliance) -> None:
    names = ["island-01/ticks", "island-02/left_ticks"]
    done = run(demo, "pd", "watch", *names, "--count", "20", "--json")
    assert done.returncode == 0, done.stderr
    changes = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(changes) == 20
    for name in names:
        ticks = [c["value"] for c in changes if f"{c['station']}/{c['variable']}" == name]
        assert len(ticks) > 2
        assert ticks == sorted(set(ticks))


def test_the_example_program_raises_the_setpoint(demo: Appliance) -> None:
    assert run(demo, "pd", "set", "island-01", "setpoint", "10").returncode == 0
    environment = os.environ | {"EAP_RUNTIME_DIR": str(demo.runtime)}
    command = [sys.executable, "docs/examples/thermostat.py", "--cycles", "60"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "setpoint" in done.stdout
    watched = run(demo, "pd", "watch", "island-01/setpoint", "--count", "1", "--json")
    assert json.loads(watched.stdout)["value"] == 70


def test_received_variable_cannot_be_set(demo: Appliance) -> None:
    done = spawn_eapctl(demo.runtime, "pd", "set", "island-02", "left_setpoint", "1")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        "variable left_setpoint is written by the engine;"
        " only variables of the application can be set\n"
    )


def test_list_agrees_with_the_plant_file(demo: Appliance) -> None:
    done = run(demo, "pd", "list", "--json")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    ids = {row["id"] for row in rows if row["direction"] == "tx"}
    assert ids == {101, 102, 103, 113}
    published = next(r for r in rows if r["direction"] == "tx" and r["id"] == 102)
    taken = next(r for r in rows if r["direction"] == "rx" and r["id"] == 102)
    assert taken["station"] == "island-03"
    for key in ("publisher", "version", "length"):
        assert taken[key] == published[key]


def test_status_counts_and_merges(demo: Appliance) -> None:
    before = json.loads(run(demo, "status", "--json").stdout)
    cycles = {station["name"]: station["cycle"] for station in before["stations"]}
    wait_until(lambda: all(demo.station(name)["cycle"] > cycles[name] + 5 for name in cycles))
    after = json.loads(run(demo, "status", "--json").stdout)
    for earlier, later in zip(before["stations"], after["stations"], strict=True):
        assert later["state"] == "OP"
        assert later["pd"]["tx"][0]["sent"] > earlier["pd"]["tx"][0]["sent"]
        assert later["pd"]["rx"][0]["received"] > earlier["pd"]["rx"][0]["received"]
        assert later["pd"]["rx"][0]["lost"] == 0
    assert [a["plant"] for a in after["appliances"]] == ["demo"]


@pytest.mark.parametrize("columns", [80, 100])
def test_status_for_people_fits(
    demo: Appliance, columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    done = run(demo, "status")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) < 24
    assert lines[0].startswith("demo: ")
    full = run(demo, "status", "--full").stdout.splitlines()
    assert max(map(len, (*lines, *full))) <= columns
    assert all(name in done.stdout for name in ISLANDS)


def test_two_appliances_are_one_answer_and_end_on_request() -> None:
    """Two halves of a plant share a runtime directory, as two commands of one user do."""
    with plants() as folder:
        plant = folder.write(HALVES)
        first = folder.start(plant, "--station", "one")
        assert first.wait_ready() == ["one"]
        with Appliance(plant, "--station", "two", runtime=first.runtime) as second:
            assert second.wait_ready() == ["two"]
            status = json.loads(run(first, "status", "--json").stdout)
            assert sorted(s["name"] for s in status["stations"]) == ["one", "two"]
            chosen = json.loads(run(first, "status", "--station", "two", "--json").stdout)
            assert [s["name"] for s in chosen["stations"]] == ["two"]
            started = time.monotonic()
            assert second.stop()[0] == 0
            assert time.monotonic() - started < 2 * slowness()
        assert run(first, "status", "--station", "two").returncode == 1
        first.process.send_signal(signal.SIGINT)
        assert first.finish()[0] == 0
        assert list(first.runtime.iterdir()) == []


def test_second_run_of_the_same_plant_is_refused(demo: Appliance) -> None:
    done = spawn_eapctl(demo.runtime, "run", str(DEMO))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert f"appliance demo already runs (process {demo.process.pid})" in done.stderr
