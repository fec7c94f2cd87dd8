"""Recordings of the key ``record``: they start, end and are restarted with the plant."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from eap.recording.recording_file import describe
from tests.support.appliance import Appliance, Plants, plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

PLANT = """\
plant: logged
defaults: {cycle_us: 10000}
stations:
  - name: one
    net_id: 127.9.61.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.61.1", net_id: 127.9.61.1.2.1}]
    variables: {ticks: UDINT, level: INT}
    sources: {ticks: {kind: counter}}
record:
  - {name: day, folder: rec, split: 300ms, keep: 3}
  - {name: fault, folder: rec, of: one/level, when: one/level>5, before: 200ms, after: 100ms}
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def appliance(folder: Plants) -> Appliance:
    (folder.folder / "rec").mkdir()
    return folder.run(folder.write(PLANT))


def state(appliance: Appliance, name: str) -> dict[str, Any]:
    lines = appliance.command("record", "list", "--json").splitlines()
    return next((row for row in map(json.loads, lines) if row["name"] == name), {})


def wait_state(appliance: Appliance, name: str, wanted: str) -> dict[str, Any]:
    wait_until(lambda: state(appliance, name).get("state") == wanted)
    return state(appliance, name)


def number(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


def test_recordings_of_the_plant_run_and_are_in_status(appliance: Appliance) -> None:
    day, fault = wait_state(appliance, "day", "recording"), wait_state(appliance, "fault", "armed")
    assert (day["is_of_plant"], fault["selected"]) == (True, 1)
    status = appliance.status()
    assert status["processes"]["recording day"]["pid"] == day["pid"]
    findings = {each["where"]: each["what"] for each in status["findings"]}
    assert findings["recording fault"] == "armed, 1 variable"


def test_recording_of_the_plant_is_not_stopped_by_a_command(appliance: Appliance) -> None:
    day = wait_state(appliance, "day", "recording")
    done = run_eapctl(appliance.runtime, "record", "stop", "day")
    assert "is in the plant file, so it ends with the plant" in done.stderr
    assert appliance.command("record", "stop", "--all") == ""
    assert state(appliance, "day")["pid"] == day["pid"]


def test_condition_of_the_plant_file_writes_a_file(appliance: Appliance) -> None:
    wait_state(appliance, "fault", "armed")
    wait_until(lambda: state(appliance, "fault")["ring_s"] >= 0.2)
    appliance.command("pd", "set", "one", "level", "9")
    wait_until(lambda: state(appliance, "fault")["triggers"] == 1)
    (path,) = wait_state(appliance, "fault", "armed")["files"]
    assert Path(path).name == "fault-0001.mcap"
    assert describe(Path(path)).seconds >= 0.2


def test_killed_recorder_of_the_plant_goes_on_behind_its_files(
    appliance: Appliance, folder: Plants
) -> None:
    files = folder.folder / "rec"
    before = wait_state(appliance, "day", "recording")
    os.kill(before["pid"], signal.SIGKILL)
    wait_until(lambda: state(appliance, "day").get("pid", 0) not in {0, before["pid"]})
    last = number(Path(before["files"][-1]))
    wait_until(lambda: min(map(number, files.glob("day-*"))) > last)
    assert len(list(files.glob("day-*"))) <= 3


def test_recording_of_the_plant_without_its_folder_has_a_reason_and_goes_on(
    appliance: Appliance, folder: Plants
) -> None:
    files = folder.folder / "rec"
    away = files.rename(folder.folder / "away")

    def reason() -> str:
        found: str = appliance.status()["processes"]["recording day"].get("fault")
        return found or ""

    wait_until(lambda: "rec: no such folder: make it" in reason())
    away.rename(files)
    wait_until(lambda: not reason() and state(appliance, "day").get("state") == "recording")


def test_recordings_end_with_the_plant(appliance: Appliance, folder: Plants) -> None:
    wait_state(appliance, "day", "recording")
    appliance.stop()
    newest = max((folder.folder / "rec").glob("day-*"), key=number)
    assert describe(newest).finished
