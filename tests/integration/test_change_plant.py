"""The solar line changes while it runs: ``plan``, ``apply``, ``rollback``, and kills in between."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest

from eap.config.new_plant import Shape, plant_text
from eap.device.rollout import without_alternates
from eap.ids import decode_value
from eap.ops.plant import load_or_raise
from eap.pd.spec import StationSpec
from tests.support.appliance import EAPCTL, Appliance, Plants, run_eapctl, troubles, wait_until

pytestmark = pytest.mark.net

SOLAR_LINE = Path(__file__).parents[2] / "config/solar-line.yaml"
CHANGED, RECEIVER = "island-05", "island-06"
VARIABLES = """\
    variables:
      pieces: {type: UDINT, comment: cells that passed}
      temperature: {type: REAL, unit: degC}
      belt: {type: BLOCK(592), comment: one octet for each place on the belt}
      position: {type: REAL, unit: mm}
      camera: {type: BLOCK(1012), comment: a line of the inspection camera}
      rejected: {type: UDINT, comment: cells that did not}
"""
NEW_PD = (
    "{name: to-right, frame: right, id: 2, version: 2,"
    " variables: [pieces, temperature, belt, rejected]}"
)


def old_text() -> str:
    """Return the solar line on addresses of this test's own."""
    return SOLAR_LINE.read_text().replace("127.0.1.", "127.9.14.")


def new_text() -> str:
    """Return the same with one variable more in one PD of one station."""
    head, mark, rest = old_text().partition(f"    name: {CHANGED}\n")
    rest = rest.replace("publish: [*to-left, *to-right,", f"publish: [*to-left, {NEW_PD},", 1)
    return f"{head}{mark}{VARIABLES}{rest}"


class Line:
    """The running solar line and the file that it is to follow."""

    def __init__(self, farm: Plants) -> None:
        self.file = farm.write(old_text(), "line.yaml")
        self.old = specs(self.file)
        self.file.write_text(new_text())
        self.new = specs(self.file)
        self.file.write_text(old_text())
        self._farm = farm
        self.appliance = self.start()

    def reset(self) -> None:
        """Have all stations run the old plant file."""
        if self.appliance.process.poll() is not None:
            self.appliance = self.start()
        self.file.write_text(old_text())
        if self.exported() != self.old:
            self.command("apply")
        wait_until(lambda: all_run(self))
        before = self.subscriptions()
        wait_until(
            lambda: all(
                rx["received"] > before[key]["received"] + 10
                for key, rx in self.subscriptions().items()
            )
        )

    def start(self) -> Appliance:
        appliance = self._farm.start(self.file, runtime=self._farm.folder / "run")
        appliance.wait_ready()
        return appliance

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return run_eapctl(self.appliance.runtime, *words)

    def command(self, *words: str) -> str:
        done = self.run(*words, str(self.file))
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def exported(self) -> dict[str, StationSpec]:
        """Return what each station runs."""
        return {
            name: msgspec.convert(
                self.appliance.request("export", station=name)["spec"],
                StationSpec,
                dec_hook=decode_value,
            )
            for name in self.old
        }

    def subscriptions(self) -> dict[tuple[str, str], dict[str, Any]]:
        return {
            (station["name"], rx["name"]): rx
            for station in self.appliance.status()["stations"]
            for rx in station["pd"]["rx"]
        }


def specs(file: Path) -> dict[str, StationSpec]:
    return {station.name: station for station in load_or_raise(file).stations}


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Line:
    return Line(module_farm)


@pytest.fixture
def line(shared: Line) -> Line:
    shared.reset()
    return shared


def assert_nothing_lost(before: dict[tuple[str, str], dict[str, Any]], line: Line) -> None:
    """Assert that all PDs came in, of the changed station and of all others."""
    wait_until(
        lambda: all(
            rx["received"] >= before[key]["received"] + 20
            for key, rx in line.subscriptions().items()
        )
    )
    after = line.subscriptions()
    assert after.keys() == before.keys()
    for key, rx in after.items():
        assert troubles(rx) == troubles(before[key]), key
        assert rx["discarded"] == before[key]["discarded"], key
        assert rx["received"] >= before[key]["received"] + 20, key
        assert rx["state"] == "running", key
    assert {station["state"] for station in line.appliance.status()["stations"]} == {"OP"}


def test_one_variable_more_in_one_pd(line: Line) -> None:
    assert line.command("plan") == "no differences: all 15 stations are as the file says\n"
    line.file.write_text(new_text())
    before = line.subscriptions()
    discarded = {each["name"]: each["discarded"] for each in line.appliance.status()["stations"]}
    plan = line.command("plan").splitlines()
    assert [text for text in plan if text.startswith("island")] == [CHANGED, RECEIVER]
    assert any("Version" in text and "1 -> 2" in text for text in plan)
    assert "2 stations of 15 to change" in "\n".join(plan)
    assert line.exported() == line.old

    done = line.command("apply").splitlines()
    assert done[-1] == "2 stations changed, 13 unchanged"
    assert not any("refused" in text for text in done)
    assert line.exported() == line.new
    line.appliance.command("pd", "set", CHANGED, "rejected", "7")
    wait_until(lambda: line.appliance.values(RECEIVER)["left.rejected"] == 7)
    assert_nothing_lost(before, line)
    stations = line.appliance.status()["stations"]
    assert {each["name"]: each["discarded"] for each in stations} == discarded
    assert line.command("plan") == "no differences: all 15 stations are as the file says\n"

    before = line.subscriptions()
    assert line.command("rollback").splitlines()[-1] == "2 stations changed, 13 unchanged"
    assert line.exported() == line.old
    assert_nothing_lost(before, line)


def test_applied_configuration_survives_a_restart(line: Line) -> None:
    line.file.write_text(new_text())
    line.command("apply")
    line.command("rollback")
    line.appliance.command("state", "control", "PREOP")
    assert line.appliance.stop() == (0, "", "")
    line.appliance = line.start()
    assert line.exported() == line.old  # although the file says otherwise
    assert line.appliance.command("state", "control") == "control: PREOP\n"
    line.appliance.command("state", "control", "OP")
    line.command("rollback")
    assert line.exported() == line.new
    told = line.appliance.stop()[2].splitlines()
    assert [text.split()[2] for text in told] == [CHANGED, RECEIVER, "control"]
    assert told[0].endswith("configured last; 'eapctl plan' shows what differs from the plant file")
    assert "starts in PREOP, requested last" in told[2]
    line.appliance = line.start()
    line.appliance.process.kill()
    line.appliance.process.wait()
    line.appliance = line.start()
    assert line.exported() == line.new


@pytest.mark.parametrize("victim", ["eapctl", "engine", "services", "supervisor"])
@pytest.mark.parametrize("delay_ms", [0, 40])
def test_a_kill_in_the_middle(line: Line, victim: str, delay_ms: int) -> None:
    line.file.write_text(new_text())
    pids = {name: line.appliance.pid(name) for name in ("engine", "services", "supervisor")}
    command = [*EAPCTL, "apply", str(line.file)]
    environment = os.environ | {"EAP_RUNTIME_DIR": str(line.appliance.runtime)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as apply:
        assert apply.stdout is not None
        apply.stdout.readline()  # one step is done, the next begins
        time.sleep(delay_ms / 1000)  # another moment of the change
        os.kill(apply.pid if victim == "eapctl" else pids[victim], signal.SIGKILL)
        apply.communicate(timeout=70)
    if victim == "supervisor":
        line.appliance.process.wait()
        line.appliance = line.start()
    elif victim != "eapctl":
        line.appliance.wait_for_another(victim, pids[victim])
    wait_until(lambda: all_run(line))
    for name, spec in line.exported().items():
        assert without_alternates(spec) in (line.old[name], line.new[name]), name
    line.file.write_text(new_text())
    line.command("apply")
    assert line.exported() == line.new
    assert all_run(line)


def test_a_change_where_cycles_and_builds_share_a_processor(farm: Plants) -> None:
    text = plant_text("ring", 3, Shape.RING, address="127.9.15.{n}", cycle_us=2000)
    file = farm.write(text, "ring.yaml")
    ring = farm.run(file, "--cpu", "0")
    for _ in range(3):
        for divider in (5, 1):
            changed = text.replace("version: 1,", f"version: 1, cycle_us: {divider * 2000},")
            file.write_text(changed)
            assert "3 stations changed" in ring.command("apply", str(file))
    assert ring.status()["processes"]["engine"]["restarts"] == 0


def all_run(line: Line) -> bool:
    """Tell whether all processes are there again and all PDs come in."""
    done = line.run("status", "--json")
    if done.returncode:
        return False
    document = json.loads(done.stdout)
    stations = document["stations"]
    return len(stations) == 15 and all(
        rx["state"] == "running" for station in stations for rx in station["pd"]["rx"]
    )
