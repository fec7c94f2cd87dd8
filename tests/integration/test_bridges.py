"""The base of bridges in a plant that runs, by a bridge to a file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from eap.runtime.bridges import BridgeFile
from tests.support.appliance import Appliance, Plants, plants
from tests.support.eventually import wait_until
from tests.support.fakebridge import FileBridgeSection, start_bridge
from tests.support.startup import read_reports

pytestmark = pytest.mark.net

PLANT = """\
plant: bridged
defaults: {cycle_us: 10000}
stations:
  - name: one
    net_id: 127.9.71.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.71.1", net_id: 127.9.71.1.2.1}
    variables: {ticks: UDINT, setpoint: UINT, locked: UINT}
    sources: {ticks: {kind: counter}}
    access: [{name: panels, allow: [write], transports: [s7]}]
  - name: two
    net_id: 127.9.71.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.71.2", net_id: 127.9.71.2.2.1}
    variables: {setpoint: UINT}
    subscribe:
      - name: from-far
        port: eap0
        from: {publisher: 9.9.9.9.2.1, id: 1}
        foreign: true
        variables: {far: UINT}
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def plant(folder: Plants) -> Appliance:
    return folder.run(folder.write(PLANT))


def plant_state(plant: Appliance) -> Path:
    return Path(plant.status()["audit"]["file"]).parent


class RunningBridge:
    """The bridge to a file as a process."""

    def __init__(self, process: subprocess.Popen[str], out: Path, requests: Path) -> None:
        self.process = process
        self.out = out
        self.requests = requests

    def lines(self) -> list[Any]:
        return [json.loads(line) for line in self.out.read_text().splitlines()]

    def values(self, name: str) -> list[Any]:
        return [line[name] for line in self.lines() if isinstance(line, dict) and name in line]

    def write(self, **values: Any) -> None:
        requests = {name.replace("__", "/"): value for name, value in values.items()}
        temporary = self.requests.with_suffix(".new")
        temporary.write_text(json.dumps(requests))
        temporary.replace(self.requests)


@contextmanager
def bridge(plant: Appliance, folder: Path, name: str, *of: str) -> Iterator[RunningBridge]:
    section = FileBridgeSection(str(folder / "out"), str(folder / "requests"), list(of))
    process, report = start_bridge(plant.runtime / "bridged", name, section)
    try:
        assert read_reports(report)[-1].ready is not None
        yield RunningBridge(process, folder / "out", folder / "requests")
    finally:
        os.close(report)
        process.kill()
        process.communicate()


def test_bridge_passes_values_and_writes_by_the_rules(plant: Appliance, tmp_path: Path):
    with bridge(plant, tmp_path, "panel", "one/*i*", "two/*") as found:
        wait_until(lambda: len(found.values("one/ticks")) > 3)
        assert found.lines()[0][:2] == ["one/setpoint", "one/ticks"]
        first, second = found.values("one/ticks")[:2]
        assert second[0] > first[0]
        # Times of cycles: as far apart as the counted cycles.
        cycles_ns = (second[0] - first[0]) * 10_000_000
        assert abs(second[2] - first[2] - cycles_ns) <= 10_000_000
        assert first[1] == "good"
        assert found.values("two/far")[0][1] == "bad"
        found.write(one__setpoint=7)
        wait_until(lambda: found.values("one/setpoint")[-1][0] == 7)
        found.write(one__ticks=1, two__setpoint=1, one__setpoint=70_000)
        wait_until(lambda: len([line for line in found.lines() if isinstance(line, str)]) == 3)
        refusals = [line for line in found.lines() if isinstance(line, str)]
        assert "variable ticks is written by the engine" in refusals[0]
        assert "no rule allows it, and other hosts only read" in refusals[1]
        assert "70000 is not a value of UINT" in refusals[2]
        found.process.send_signal(signal.SIGTERM)
        assert found.process.wait(10) == 0
        assert found.lines()[-1] == "ended"
        lines = (plant_state(plant) / "audit.jsonl").read_text().splitlines()
        assert {json.loads(line).get("by") for line in lines} == {"s7:10.9.9.9"}
        status = BridgeFile(plant.runtime / "bridged", "panel").read()
        assert status is not None
        assert status.is_up
        assert (status.received, status.refused, status.pid) == (4, 3, found.process.pid)
        assert status.sent > 4


def test_bridge_follows_services_and_engine_that_are_killed(plant: Appliance, tmp_path: Path):
    with bridge(plant, tmp_path, "panel", "one/ticks") as found:
        for name in ("services", "engine"):
            wait_until(lambda: found.values("one/ticks"))
            pid, count = plant.pid(name), len(found.values("one/ticks"))
            os.kill(pid, signal.SIGKILL)
            plant.wait_for_another(name, pid)
            wait_until(lambda count=count: len(found.values("one/ticks")) > count + 3)


def test_bridge_ends_with_its_supervisor(plant: Appliance, tmp_path: Path):
    section = FileBridgeSection(str(tmp_path / "out"), str(tmp_path / "requests"), ["one/*"])
    # Another parent than the one it is told stands for a supervisor that was killed.
    process, report = start_bridge(plant.runtime / "bridged", "orphan", section, parent=1)
    os.close(report)
    process.communicate(timeout=20)
    assert process.returncode == 0


def test_bridge_that_cannot_start_reports_the_reason(plant: Appliance, tmp_path: Path):
    section = FileBridgeSection(str(tmp_path / "none" / "out"), "", ["one/*"])
    process, report = start_bridge(plant.runtime / "bridged", "broken", section)
    with os.fdopen(report) as steps:
        assert "No such file or directory" in steps.readlines()[-1]
    _, err = process.communicate(timeout=20)
    assert process.returncode == 2
    assert err.startswith(f"broken: {tmp_path}/none/out: No such file")
