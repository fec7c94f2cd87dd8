"""From a killed recorder to a replay: the same values bit by bit in every step."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from eap.recording.frames_reader import FramesFile
from eap.recording.recording_file import describe
from eap.recording.replay import frames_of
from tests.support.appliance import EAPCTL, Appliance, Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

PLANT = """\
plant: pair
defaults: {cycle_us: 10000}
stations:
  - name: left
    net_id: 127.9.62.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.62.1", net_id: 127.9.62.1.2.1}]
    variables:
      ticks: UDINT
      wave: {type: LREAL, unit: mm}
      note: {type: "STRING(8)", default: "ab,c"}
    sources:
      ticks: {kind: counter}
      wave: {kind: sine, amplitude: 3.3, period_ms: 700}
    frames: [{name: out, port: eap0, to: right/eap0}]
    publish: [{name: state, frame: out, id: 1, cycle_us: 20000, variables: [ticks, wave, note]}]
  - name: right
    net_id: 127.9.62.2.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.62.2", net_id: 127.9.62.2.2.1}]
    subscribe: [{name: state, port: eap0, from: left/state}]
"""


def states(appliance: Appliance) -> list[dict[str, Any]]:
    lines = appliance.command("record", "list", "--json").splitlines()
    return [json.loads(line) for line in lines]


def record(appliance: Appliance, target: Path, *words: str) -> None:
    appliance.command("record", "start", "-o", str(target), *words)


def messages(appliance: Appliance, name: str) -> int:
    return next(int(state["messages"]) for state in states(appliance) if state["name"] == name)


def wait_messages(appliance: Appliance, number: int) -> None:
    wait_until(lambda: all(state["messages"] >= number for state in states(appliance)))


class Kept:
    """Recordings of a pair of stations whose recorders were killed."""

    def __init__(self, farm: Plants, folder: Path) -> None:
        self.farm = farm
        self.plant = farm.write(PLANT)
        self.folder = folder
        self.values, self.frames = folder / "v.mcap", folder / "f.pcapng"
        both = farm.run(self.plant)
        record(both, folder / "v", "left")
        record(both, folder / "f", "--frames")
        wait_messages(both, 300)
        self.refused = run_eapctl(both.runtime, "replay", str(self.values), "--only", "left")
        for state in states(both):
            os.kill(state["pid"], signal.SIGKILL)
        both.process.send_signal(signal.SIGINT)
        both.finish()
        # A process that is killed while it writes to a busy disk ends when that is done.
        wait_until(lambda: not any(describe(each).recording for each in (self.values, self.frames)))


@pytest.fixture(scope="module")
def kept(module_farm: Plants, tmp_path_factory: pytest.TempPathFactory) -> Kept:
    return Kept(module_farm, tmp_path_factory.mktemp("kept"))


@pytest.fixture(scope="module")
def right(kept: Kept) -> Appliance:
    """The subscriber alone."""
    return kept.farm.run(kept.plant, "--station", "right")


def table(path: Path, *words: str) -> dict[str, tuple[str, str]]:
    """Return wave and note by ticks, from CSV."""
    out = path.with_suffix(".csv")
    done = run_eapctl(path.parent, "export", str(path), "--csv", "-o", str(out), "--force", *words)
    assert done.returncode == 0, done.stderr
    with out.open(newline="") as file:
        return {
            row["left/ticks"]: (row["left/wave"], row["left/note"]) for row in csv.DictReader(file)
        }


def test_publisher_that_is_alive_is_refused(kept: Kept) -> None:
    assert kept.refused.returncode == 1
    assert "publisher 127.9.62.1.2.1 (left/eap0) is alive" in kept.refused.stderr


def test_killed_recordings_of_values_and_frames_have_the_same_values(kept: Kept) -> None:
    for path in (kept.values, kept.frames):
        info = describe(path)
        assert info.messages > 50
        assert (info.lost, info.recording, info.plant) == (0, False, "pair")
    assert not describe(kept.values).finished
    values, frames = table(kept.values), table(kept.frames)
    common = values.keys() & frames.keys()
    # The values of every second cycle are sent, and both recorders lost up to a second.
    assert len(common) > 50
    assert {key: values[key] for key in common} == {key: frames[key] for key in common}
    # A killed recorder ends earlier than the other one: what was sent before that is in both.
    ends = min(map(int, values)), max(map(int, values))
    assert common == {key for key in frames if ends[0] <= int(key) <= ends[1]}
    assert len({wave for wave, _ in values.values()}) > 20
    assert {note for _, note in values.values()} == {"ab,c"}
    picture = kept.folder / "x.svg"
    done = run_eapctl(kept.folder, "plot", str(kept.values), "wave", "--out", str(picture))
    assert done.returncode == 0, done.stderr
    assert picture.read_text().startswith("<svg")


def test_replayed_frames_arrive_as_they_were_recorded(kept: Kept, right: Appliance) -> None:
    again = kept.folder / "again"
    record(right, again, "--frames")
    sent = [each.data for each in frames_of(FramesFile(kept.frames), {}, "left")]
    words = [*EAPCTL, "replay", str(kept.frames), "--only", "left", "--rate", "4", "--json"]
    environment = os.environ | {"EAP_RUNTIME_DIR": str(right.runtime)}
    replay = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)

    def replayed() -> list[dict[str, Any]]:
        stations = json.loads(right.command("status", "--json"))["stations"]
        return [station for station in stations if "replayed" in station]

    wait_until(lambda: replayed() or replay.poll() is not None)
    out, _ = replay.communicate(timeout=60)
    result = json.loads(out)
    assert (replay.returncode, result["sent"], result["failed"]) == (0, len(sent), {})
    wait_until(lambda: messages(right, "again") >= len(sent))
    right.command("record", "stop", "again")
    received = [each.data for each in FramesFile(again.with_suffix(".pcapng")).frames()]
    assert received == sent
    (rx,) = json.loads(right.command("status", "--json"))["stations"][0]["pd"]["rx"]
    assert (rx["received"], rx["lost"]) == (len(sent), 0)


def test_replayed_values_arrive_as_they_were_recorded(kept: Kept, right: Appliance) -> None:
    again = kept.folder / "values"
    record(right, again, "--frames")
    done = run_eapctl(right.runtime, "replay", str(kept.values), "--rate", "4", "--json")
    assert done.returncode == 0, done.stderr
    count = json.loads(done.stdout)["sent"]
    wait_until(lambda: messages(right, "values") >= count)
    right.command("record", "stop", "values")
    found = table(again.with_suffix(".pcapng"), "--plant", str(kept.plant))
    recorded = table(kept.values)
    assert len(found) == count > 50
    assert {key: recorded[key] for key in found} == found


def test_status_shows_a_replay_and_stop_ends_it(kept: Kept, tmp_path: Path) -> None:
    words = [*EAPCTL, "replay", str(kept.values), "--loop", "--force", "--json"]
    environment = os.environ | {"EAP_RUNTIME_DIR": str(tmp_path)}
    replay = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: run_eapctl(tmp_path, "status").returncode == 0)
        text = run_eapctl(tmp_path, "status").stdout
        (station,) = json.loads(run_eapctl(tmp_path, "status", "--json").stdout)["stations"]
        assert station["name"] == "left (replayed)"
        assert station["replayed"]["loop"] is True
        assert "left (replayed): replayed from" in " ".join(text.split())
        assert "pair (replay): no errors, 1 warning" in text
        second = run_eapctl(tmp_path, "replay", str(kept.values), "--force")
        assert (second.returncode, "a replay of pair runs already" in second.stderr) == (2, True)
        recorded = run_eapctl(tmp_path, "record", "start", "-o", str(tmp_path / "x"))
        assert (recorded.returncode, "no plant runs here" in recorded.stderr) == (1, True)
        rows = run_eapctl(tmp_path, "top", "--once", "--json", "--interval", "0.5").stdout
        assert 20 < json.loads(rows)["tx_per_s"] < 80
    finally:
        replay.send_signal(signal.SIGINT)
    out, _ = replay.communicate(timeout=30)
    assert (replay.returncode, json.loads(out)["left_out"]) == (0, {})
    assert not list(tmp_path.glob("*/control"))


def test_port_in_use_is_refused_where_no_appliance_is_seen(kept: Kept, tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.9.62.1", 34980))
        done = run_eapctl(tmp_path, "replay", str(kept.values))
        assert done.returncode == 1
        assert "is alive: 127.9.62.1:34980 is in use" in done.stderr


def test_step_sends_a_frame_for_each_line(kept: Kept, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "eap", "replay", str(kept.values), "--step", "--json"]
    environment = os.environ | {"EAP_RUNTIME_DIR": str(tmp_path)}
    done = subprocess.run(
        words, input="\n\n\n", env=environment, capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout)["sent"] == 3
    assert done.stderr.count("left/eap0 → 127.9.62.2: state") == 4


def test_step_ends_by_ctrl_c_while_it_waits_for_a_line(kept: Kept, tmp_path: Path) -> None:
    words = [*EAPCTL, "replay", str(kept.values), "--step", "--json"]
    replay = subprocess.Popen(
        words,
        env=os.environ | {"EAP_RUNTIME_DIR": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert replay.stdin is not None
    assert replay.stderr is not None
    assert "sending" in replay.stderr.readline()
    assert replay.stderr.read(4) == "left"
    replay.send_signal(signal.SIGINT)
    assert replay.wait(timeout=30) == 0
    out, _ = replay.communicate()
    assert json.loads(out)["sent"] == 0


def test_dry_run_sends_nothing_and_names_every_frame(kept: Kept, tmp_path: Path) -> None:
    done = run_eapctl(tmp_path, "replay", str(kept.values), "--dry-run", "--json", "--rate", "2")
    result = json.loads(done.stdout)
    (row,) = result["frames"]
    assert (row["station"], row["port"], row["pds"]) == ("left", "eap0", ["state"])
    assert row["destination"] == "127.9.62.2"
    assert result["sent"] == 0
    assert 60 < row["per_s"] < 110


def test_plot_of_a_running_station_is_written(right: Appliance, tmp_path: Path) -> None:
    picture = tmp_path / "x.svg"
    words = ["plot", "right", "state.ticks", "state.wave", "--for", "0.3", "--out", str(picture)]
    done = run_eapctl(right.runtime, *words)
    assert done.returncode == 0, done.stderr
    text = picture.read_text()
    assert "right/state.wave" in text
    assert ">mm</text>" in text
    done = run_eapctl(right.runtime, "plot", "right", "state.note", "--for", "1")
    assert (done.returncode, "no numbers among state.note" in done.stderr) == (2, True)
