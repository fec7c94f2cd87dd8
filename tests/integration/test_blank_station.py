"""A station that starts with nothing and is configured by ``eapctl od write`` alone."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from eap.od.profiles.eap1000 import FrameSub
from tests.support.appliance import Appliance, Plants, run_eapctl, troubles, wait_until

pytestmark = pytest.mark.net

PANEL = """\
plant: hall
stations:
  - name: panel
    net_id: 127.9.8.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.8.1", net_id: 127.9.8.1.2.1}
    variables:
      target: {type: UINT, default: 50}
    frames:
      - {name: to-mixer, port: eap0, to: 127.9.8.2}
    publish:
      - {name: command, frame: to-mixer, id: 1, version: 3, variables: [target]}
    subscribe:
      - name: mixer
        port: eap0
        from: {publisher: 127.9.8.2.2.1, id: 2, cycle_us: 10000, step: 2}
        foreign: true
        variables: {speed: REAL, ready: BOOL}
"""
BLANK = ["--blank", "mixer", "--interface", "udp://127.9.8.2", "--net-id", "127.9.8.2.2.1"]
WRITES = [
    # What it sends: two variables, in a PDO, in a PD, in a frame.
    ("0x6000:4", "REAL"),
    ("0x6000:5", "speed"),
    ("0x6001:4", "BOOL"),
    ("0x6001:5", "ready"),
    ("0x1A00:1", "6000:01/32"),
    ("0x1A00:2", "6001:01/1"),
    ("0x1A00:0", "2"),
    ("0xD000:1", "0x1A00"),
    ("0xD000:3", "2"),
    ("0xD000:7", "20000"),
    ("0xD000:0E", "state"),
    ("0xD000:5", "true"),
    ("0x8000:2", "2"),
    ("0x8000:5", "127.9.8.1"),
    (f"0x8000:{FrameSub.TXPD:X}", "0xD000"),
    ("0x8000:1", "true"),
    # What it receives.
    ("0x7000:4", "UINT"),
    ("0x7000:5", "target"),
    ("0x1600:1", "7000:01/16"),
    ("0x1600:0", "1"),
    ("0xE000:1", "0x1600"),
    ("0xE000:3", "1"),
    ("0xE000:4", "3"),
    ("0xE000:6", "127.9.8.1.2.1"),
    ("0xE000:0B", "command"),
    ("0xE000:5", "0x80"),
]


class Hall:
    """Both stations, and commands about them."""

    def __init__(self, farm: Plants) -> None:
        self.runtime = farm.folder / "run"
        self.panel = farm.start(farm.write(PANEL), runtime=self.runtime)
        self.panel.wait_ready()
        self._farm = farm
        self.mixer = self.start_mixer()

    def start_mixer(self) -> Appliance:
        mixer = self._farm.start(None, *BLANK, runtime=self.runtime)
        mixer.wait_ready()
        return mixer

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return run_eapctl(self.runtime, *words)

    def command(self, *words: str) -> str:
        done = self.run(*words)
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture
def hall(farm: Plants) -> Hall:
    return Hall(farm)


def test_configured_by_downloads_alone(hall: Hall, tmp_path: Path) -> None:
    assert hall.command("state", "mixer") == "mixer: PREOP\n"
    assert "\n0x6000" not in hall.command("od", "dump", "mixer")
    for entry, value in WRITES:
        hall.command("od", "write", "mixer", entry, value)
    assert hall.command("state", "mixer", "OP") == "mixer: OP\n"

    def panel() -> dict[str, Any]:
        return hall.panel.rx("panel", "mixer")

    def mixer() -> dict[str, Any]:
        return hall.mixer.rx("mixer", "command")

    wait_until(lambda: panel()["received"] > 20 and mixer()["received"] > 20)
    assert troubles(panel()) == (0, 0, 0)
    assert panel()["discarded"] == {}
    assert mixer()["discarded"].keys() <= {"stale", "suppressed"}  # of the time in PREOP
    hall.command("pd", "set", "mixer", "speed", "1.5")
    hall.command("pd", "set", "panel", "target", "75")
    wait_until(lambda: hall.panel.values("panel")["speed"] == 1.5)
    wait_until(lambda: hall.mixer.values("mixer")["target"] == 75)
    row = json.loads(hall.command("od", "read", "mixer", "0x7000:1", "--json"))
    assert (row["type"], row["value"]) == ("UINT", 75)

    refused = hall.run("od", "write", "mixer", "0xD000:7", "30000")
    assert refused.returncode == 1
    assert "(0x08000022)" in refused.stderr
    assert "eapctl state mixer PREOP" in refused.stderr

    # All of it goes into a blank station that takes the place of this one.
    file = tmp_path / "mixer.od"
    file.write_text(hall.command("od", "dump", "mixer"))
    assert hall.mixer.stop()[0] == 0
    hall.mixer = hall.start_mixer()
    assert "entries written" in hall.command("od", "write", "mixer", "--from", str(file))
    assert hall.command("state", "mixer", "OP") == "mixer: OP\n"
    wait_until(lambda: mixer()["received"] > 5)
    assert hall.command("od", "dump", "mixer").count("\n0x") == file.read_text().count("\n0x")


def test_plant_that_cannot_run_is_reported(hall: Hall) -> None:
    hall.command("od", "write", "mixer", "0xD000:5", "true")
    refused = hall.run("state", "mixer", "SAFEOP")
    assert refused.returncode == 1
    assert refused.stdout == "mixer: PREOP\n"
    assert "SAFEOP was refused: 0xD000:00: PD is in no frame: txpd0 (0x8008)" in refused.stderr
    refused = hall.run("od", "write", "mixer", "0x1A00:1", "6009:01/16")
    assert refused.returncode == 1
    assert "0x1A00:01: object does not exist (0x06020000)" in refused.stderr


def test_blank_station_is_blank_by_default(farm: Plants) -> None:
    runtime = farm.folder / "run"
    first = farm.start(None, *BLANK, runtime=runtime)
    first.wait_ready()
    assert run_eapctl(runtime, "od", "write", "mixer", "0x6000:5", "speed").returncode == 0
    assert run_eapctl(runtime, "state", "mixer", "OP").returncode == 0
    first.stop()
    second = farm.start(None, *BLANK, "--resume", runtime=runtime)
    second.wait_ready()
    assert second.station("mixer")["state"] == "OP"
    assert '"speed"' in run_eapctl(runtime, "od", "read", "mixer", "0x6000:5").stdout
    second.stop()
    third = farm.start(None, *BLANK, runtime=runtime)
    third.wait_ready()
    assert third.station("mixer")["state"] == "PREOP"
    assert run_eapctl(runtime, "od", "read", "mixer", "0x6000:5").returncode == 1
