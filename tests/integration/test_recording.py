"""Recordings of a running plant: over kills, changes, faults and full disks."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from eap.recording.frames_reader import FramesFile
from eap.recording.recording_file import describe, iso_time, open_recording
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

PLANT = """\
plant: line
defaults: {cycle_us: 10000}
stations:
  - name: left
    net_id: 127.9.61.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.61.1", net_id: 127.9.61.1.2.1}
      - {name: eap1, kind: eap, interface: "loop://short", net_id: 127.9.61.1.3.1}
      - {name: bus0, kind: bus, interface: "sim://oven.yaml", net_id: 127.9.61.1.4.1}
    variables:
      ticks: UDINT
      level: {type: REAL, unit: mm}
    sources:
      ticks: {kind: counter}
    frames:
      - {name: out, port: eap0, to: right/eap0}
      - {name: near, port: eap1, to: right/eap1}
    publish:
      - {name: state, frame: out, id: 1, variables: [ticks, level]}
      - {name: again, frame: near, id: 2, variables: [ticks]}
  - name: right
    net_id: 127.9.61.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.61.2", net_id: 127.9.61.2.2.1}
      - {name: eap1, kind: eap, interface: "loop://short", net_id: 127.9.61.2.3.1}
    subscribe:
      - {name: state, port: eap0, from: left/state}
      - {name: again, port: eap1, from: left/again, variables: {near_ticks: UDINT}}
"""

OVEN = """\
bus: oven
slaves:
  - name: door
    kind: digital
    inputs: [{name: is_closed}]
"""


@pytest.fixture(scope="module")
def line(module_farm: Plants) -> Appliance:
    """One plant for all tests that do not end it."""
    module_farm.write(OVEN, "oven.yaml")
    return module_farm.run(module_farm.write(PLANT))


class Recordings:
    """Recordings of one appliance, in a folder of the test."""

    def __init__(self, appliance: Appliance, folder: Path) -> None:
        self.appliance = appliance
        self.folder = folder

    def start(self, name: str, *words: str) -> dict[str, Any]:
        target = str(self.folder / name)
        return self._json("start", "-o", target, *words)

    def stop(self, name: str) -> dict[str, Any]:
        return self._json("stop", name)

    def state(self, name: str) -> dict[str, Any]:
        lines = self.appliance.command("record", "list", "--json").splitlines()
        return next(row for row in map(json.loads, lines) if row["name"] == name)

    def wait_messages(self, name: str, more: int) -> None:
        wanted = self.state(name)["messages"] + more
        wait_until(lambda: self.state(name)["messages"] >= wanted)

    def end_all(self) -> None:
        for line in self.appliance.command("record", "list", "--json").splitlines():
            if (state := json.loads(line))["state"] not in {"ended", "killed"}:
                self.stop(state["name"])

    def _json(self, *words: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.appliance.command("record", *words, "--json"))
        return found


@pytest.fixture
def recordings(line: Appliance, tmp_path: Path) -> Iterator[Recordings]:
    found = Recordings(line, tmp_path)
    yield found
    found.end_all()


def test_values_of_every_cycle_are_recorded_until_the_stop(recordings: Recordings) -> None:
    started = recordings.start("values", "left", "right/near_*")
    assert (started["state"], started["selected"], started["kind"]) == ("recording", 11, "values")
    recordings.wait_messages("values", 40)
    recordings.appliance.command("record", "mark", "door open")
    rows = {each["where"]: each["what"] for each in recordings.appliance.status()["findings"]}
    assert rows["recording values"] == "recording, 11 variables"
    ended = recordings.stop("values")
    assert (ended["state"], ended["lost"]) == ("ended", 0)
    (path,) = ended["files"]
    info = describe(Path(path))
    assert info.messages == ended["messages"] > 40
    assert (info.plant, info.lost, info.finished) == ("line", 0, True)
    assert {"left/ticks", "left/level", "right/near_ticks"} <= set(info.variables)
    assert [event.text for event in info.events] == ["door open"]
    assert info.files == ["plant.yaml"]


def test_frames_of_all_kinds_of_ports_are_recorded_on_both_sides(recordings: Recordings) -> None:
    assert recordings.start("frames", "--frames")["selected"] == 5
    recordings.wait_messages("frames", 100)
    ended = recordings.stop("frames")
    info = describe(Path(ended["files"][0]))
    assert (info.lost, info.kind) == (0, "frames")
    ports = ["left/bus0", "left/eap0", "left/eap1", "right/eap0", "right/eap1"]
    assert sorted(info.interfaces) == ports
    assert info.messages == ended["messages"]
    recording = open_recording(Path(ended["files"][0]))
    assert isinstance(recording, FramesFile)
    found = {
        (recording.interfaces[each.captured.interface], each.captured.outbound, each.data[1] >> 4)
        for each in recording.frames()
    }
    on_bus = {("left/bus0", True, 1), ("left/bus0", False, 1)}
    assert found == on_bus | {(port, port.startswith("left"), 4) for port in ports[1:]}


def test_recorder_goes_on_when_processes_are_killed(recordings: Recordings) -> None:
    recordings.start("killed", "left/ticks")
    recordings.start("framed", "left/eap0", "--frames")
    for process in ("engine", "services"):
        before = recordings.appliance.pid(process)
        os.kill(before, signal.SIGKILL)
        recordings.appliance.wait_for_another(process, before)
        recordings.wait_messages("killed", 20)
        recordings.wait_messages("framed", 20)
    values, frames = recordings.stop("killed"), recordings.stop("framed")
    assert (values["lost"], len(values["files"])) == (0, 1)
    assert (frames["lost"], len(frames["files"])) == (0, 1)
    events = describe(Path(values["files"][0])).events
    assert events
    assert all("the engine was restarted" in event.text for event in events)


def test_recording_that_is_killed_is_listed_and_readable(recordings: Recordings) -> None:
    pid = recordings.start("dead")["pid"]
    recordings.wait_messages("dead", 400)  # two seconds
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: recordings.state("dead")["state"] == "killed")
    state = recordings.state("dead")
    info = describe(Path(state["files"][0]))
    assert not info.finished
    assert info.messages >= 200
    refused = run_eapctl(recordings.appliance.runtime, "record", "stop", "dead")
    assert refused.returncode == 1
    assert "no recording 'dead' runs" in refused.stderr


def test_changed_station_begins_another_file(recordings: Recordings, module_farm: Plants) -> None:
    plant = recordings.appliance
    recordings.start("before", "left")
    recordings.start("beside", "right")
    recordings.wait_messages("before", 20)
    text = PLANT.replace("      level: {", "      more: LINT\n      level: {")
    changed = module_farm.write(text, "changed.yaml")
    plant.command("apply", str(changed))
    wait_until(lambda: len(recordings.state("before")["files"]) == 2)
    recordings.wait_messages("before", 20)
    first, second = (describe(Path(each)) for each in recordings.stop("before")["files"])
    assert "left/more" in set(second.variables) - set(first.variables)
    assert first.lost == second.lost == 0
    assert recordings.state("before")["lost"] == 0
    # What the other station publishes is unchanged, and so is what is recorded of it.
    assert recordings.stop("beside")["lost"] == 0


def test_trigger_has_every_cycle_before_and_behind_a_fault_at_any_moment(
    recordings: Recordings,
) -> None:
    when = ["--when", "left/level>80 or lost", "--before", "1s", "--after", "1s"]
    recordings.start("fault", "left", "--ring", "3s", *when)
    assert recordings.state("fault")["state"] == "armed"
    wait_until(lambda: recordings.state("fault")["ring_s"] >= 1.2 + random.random())
    assert recordings.state("fault")["files"] == []
    recordings.appliance.command("pd", "set", "left", "level", "81")
    wait_until(lambda: recordings.state("fault")["files"])
    wait_until(lambda: recordings.state("fault")["state"] == "armed")
    recordings.appliance.command("pd", "set", "left", "level", "5")
    ended = recordings.stop("fault")
    assert (ended["triggers"], ended["lost"]) == (1, 0)
    (path,) = ended["files"]
    (event,) = describe(Path(path)).events
    assert (event.kind, event.text) == ("trigger", "left/level>80 or lost")
    recording = open_recording(Path(path))
    (source,) = recording.sources
    columns = [each.name for each in recording.sources[source].columns]
    rows = list(recording.rows())
    levels = [row.values[columns.index("left/level")] for row in rows]
    ticks = [row.values[columns.index("left/ticks")] for row in rows]
    # The counter of the plant shows that no cycle is missing.
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    fault = levels.index(81.0)
    assert set(levels[:fault]) < {0.0, 5.0}
    assert rows[fault].time_ns - rows[0].time_ns >= 0.98e9  # a cycle is 10 ms
    assert rows[-1].time_ns - rows[fault].time_ns >= 0.98e9
    assert event.time == iso_time(rows[fault].time_ns)


def test_snapshot_writes_the_ring_and_goes_on(recordings: Recordings) -> None:
    recordings.start("ring", "--frames", "--ring", "1s")
    wait_until(lambda: recordings.state("ring")["ring_s"] >= 0.9)
    recordings.appliance.command("record", "mark", "now")
    recordings.appliance.command("record", "snapshot")
    recordings.appliance.command("record", "snapshot", "ring")
    ended = recordings.stop("ring")
    first, second = (describe(Path(each)) for each in ended["files"])
    assert first.messages > 100
    assert second.seconds >= 0.9
    assert [event.text for event in first.events] == ["now"]
    refused = run_eapctl(recordings.appliance.runtime, "record", "snapshot")
    assert "no recording runs" in refused.stderr


def test_recording_is_divided_and_bounded(recordings: Recordings) -> None:
    recordings.start("split", "--split", "300ms", "--keep", "2", "--every", "50ms")
    wait_until(
        lambda: (
            recordings.state("split")["files"][-1:] >= [str(recordings.folder / "split-0005.mcap")]
        )
    )
    ended = recordings.stop("split")
    left = sorted(recordings.folder.glob("split-*"))
    assert [str(each) for each in left] == ended["files"]
    assert len(left) == 2
    assert all(describe(each).finished for each in left)
    assert ended["messages"] > sum(describe(each).messages for each in left)


def test_recording_for_a_time_ends_by_itself(recordings: Recordings) -> None:
    recordings.start("short", "left/ticks", "--for", "500ms")
    wait_until(lambda: recordings.state("short")["state"] == "ended")
    state = recordings.state("short")
    assert state["reason"] == "0.5 s are over"
    assert 40 <= describe(Path(state["files"][0])).messages <= 60


@pytest.mark.parametrize(
    ("words", "problem", "code"),
    [
        (["lefft"], "lefft: it selects no variable, did you mean left?", 1),
        (["left/tick"], "did you mean left/ticks?", 1),
        (["left/eap9", "--frames"], "it selects no port", 1),
        (["--when", "left/levell>1"], "did you mean level", 1),
        (["--when", "left/level>"], "a name or a value is expected", 2),
        (["--before", "3s"], "--before: it needs a condition", 2),
        (["--frames", "--every", "3"], "--every: it is for values", 2),
        (["--for", "soon"], "'soon' is not a time: expected for example 20s", 2),
        (["--split", "3 miles"], "expected a time such as 1h, or a size such as 1GB", 2),
        (["--plant", "other"], "no plant 'other' runs here", 1),
        (["-o", "/nowhere/x"], "/nowhere: no such folder", 2),
    ],
)
def test_wrong_options_are_refused(
    recordings: Recordings, words: list[str], problem: str, code: int
) -> None:
    done = run_eapctl(recordings.appliance.runtime, "record", "start", *words)
    assert problem in done.stderr
    assert done.returncode == code
    assert "wrong" not in recordings.appliance.command("record", "list")


def test_recorder_ends_in_order_when_its_folder_is_removed(recordings: Recordings) -> None:
    state = recordings.start("homeless", "left/ticks")
    recordings.wait_messages("homeless", 20)
    shutil.rmtree(recordings.appliance.runtime / ".recordings" / "homeless")
    wait_until(lambda: describe(Path(state["files"][0])).finished)


def test_file_that_exists_is_not_overwritten(recordings: Recordings) -> None:
    (recordings.folder / "old.mcap").write_bytes(b"precious")
    target = str(recordings.folder / "old.mcap")
    done = run_eapctl(recordings.appliance.runtime, "record", "start", "-o", target)
    assert (done.returncode, "exists: choose another name" in done.stderr) == (2, True)
    assert (recordings.folder / "old.mcap").read_bytes() == b"precious"


def test_recording_waits_while_its_plant_does_not_run(farm: Plants, tmp_path: Path) -> None:
    without_bus = "".join(line for line in PLANT.splitlines(keepends=True) if "bus0" not in line)
    plant = farm.write(without_bus.replace("127.9.61", "127.9.62"))
    first = farm.run(plant)
    recordings = Recordings(first, tmp_path)
    recordings.start("patient", "left/ticks")
    recordings.wait_messages("patient", 20)
    first.stop()
    wait_until(lambda: recordings.state("patient")["state"] == "waiting")
    assert recordings.state("patient")["reason"] == "the plant does not run"
    again = farm.start(plant, runtime=first.runtime)
    again.wait_ready()
    recordings.wait_messages("patient", 20)
    ended = recordings.stop("patient")
    assert len(ended["files"]) == 2
    assert all(describe(Path(each)).finished for each in ended["files"])


@pytest.mark.root
def test_recording_ends_when_the_disk_is_nearly_full(line: Appliance, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(disk)], check=True)
    try:
        recordings = Recordings(line, disk)
        recordings.start("full", "--frames", "--split", "200KB")
        recordings.wait_messages("full", 20)
        (disk / "others").write_bytes(bytes(4 << 20))
        wait_until(lambda: recordings.state("full")["state"] == "ended")
        state = recordings.state("full")
        assert state["reason"].startswith(f"the disk is nearly full: {disk} has ")
        assert all(describe(Path(each)).finished for each in state["files"])
        done = run_eapctl(line.runtime, "record", "start", "-o", str(disk / "more"))
        assert "the disk is nearly full" in done.stderr
        assert done.returncode == 1
    finally:
        subprocess.run(["umount", str(disk)], check=True)
