"""``eapctl top`` on terminals of tmux: faults of a plant on a cable, in words."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import copy
from typing import NamedTuple

import pytest

from eap.recording.recording_file import describe
from tests.support.appliance import EAPCTL, Appliance, Plants, wait_until
from tests.support.namespaces import Namespace, cable
from tests.support.tmux import HAS_TMUX, Terminal, terminal

pytestmark = [
    pytest.mark.net,
    pytest.mark.root,
    pytest.mark.skipif(not HAS_TMUX, reason="needs tmux"),
]

BUSES = Path(__file__).parents[2] / "config" / "buses"
HERE, THERE = "10.88.164.1", "10.88.164.2"
PLANT = f"""\
plant: hall
defaults: {{cycle_us: 10000}}
stations:
  - name: left
    net_id: {HERE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{HERE}", net_id: {HERE}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://io.yaml", net_id: {HERE}.3.1}}
    variables: {{ticks: UDINT}}
    sources: {{ticks: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: right/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [ticks]}}]
    subscribe: [{{name: from-right, port: eap0, from: right/state, timeout_ms: 200}}]
  - name: right
    net_id: {THERE}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{THERE}", net_id: {THERE}.2.1}}]
    variables: {{beats: UDINT}}
    sources: {{beats: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: left/eap0}}]
    publish: [{{name: state, frame: out, id: 2, variables: [beats]}}]
    subscribe: [{{name: from-left, port: eap0, from: left/state, timeout_ms: 200}}]
"""
SMALL, LARGE = (80, 24), (160, 50)


class Hall(NamedTuple):
    """Two appliances with one cable between them, which one view shows."""

    left: Appliance
    right: Appliance
    here: Namespace
    there: Namespace
    farm: Plants

    def engine_of_left(self) -> int:
        """Return the process id of the engine of the left station."""
        appliances = json.loads(self.left.command("status", "--json"))["appliances"]
        (pid,) = (
            each["processes"]["engine"]["pid"] for each in appliances if "left" in each["stations"]
        )
        return int(pid)

    @contextmanager
    def top(
        self, *options: str, size: tuple[int, int] = SMALL, **environment: str
    ) -> Iterator[Terminal]:
        """Open the overview on a terminal."""
        command = [*EAPCTL, "top", *options]
        runtime = {"EAP_RUNTIME_DIR": str(self.left.runtime)}
        with terminal(self.farm.folder, command, size, **runtime | environment) as found:
            yield found


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Iterator[Hall]:
    for name in ("io.yaml", "level.csv"):
        copy(BUSES / name, module_farm.folder / name)
    plant, runtime = module_farm.write(PLANT), module_farm.folder / "run"
    with cable(addresses=True) as (here, there):
        left, right = (
            module_farm.start(plant, "--station", name, prefix=end.prefix, runtime=runtime)
            for name, end in (("left", here), ("right", there))
        )
        assert (left.wait_ready(), right.wait_ready()) == (["left"], ["right"])
        yield Hall(left, right, here, there, module_farm)


@pytest.fixture
def hall(shared: Hall, monkeypatch: pytest.MonkeyPatch) -> Hall:
    """Return the hall when nothing is wrong in it."""
    shared.there.plug()

    def is_well() -> bool:
        done = shared.left.command("status", "--json")
        return all(each["severity"] != "error" for each in json.loads(done)["findings"])

    wait_until(is_well)
    return shared


def begin(screen: Terminal) -> None:
    """Wait until both stations are shown with their rates."""
    screen.wait_for("hall: 2/2 OP", "left", "right", "4/4 OP")


@pytest.mark.parametrize("size", [SMALL, LARGE])
def test_lossy_line_cut_cable_and_killed_engine_are_named(
    hall: Hall, size: tuple[int, int]
) -> None:
    bucket = ("root", "tbf", "rate", "40kbit", "burst", "1600", "limit", "1600")
    with hall.top(size=size) as screen:
        begin(screen)
        control(hall.here, "add", *bucket)
        try:
            screen.wait_until(lambda text: "right: " in text and " lost: from-left" in text)
            screen.wait_until(lambda text: "!" in text)  # in the last minute
        finally:
            control(hall.here, "del", *bucket[:1])
        hall.there.unplug()
        screen.press("5")
        screen.wait_for("left/eap0", "link down", "stale: nothing received within the timeout")
        hall.there.plug()
        screen.wait_for("over after", ": link down")
        os.kill(hall.engine_of_left(), signal.SIGKILL)
        screen.wait_for("hall (left) engine", "ended and was restarted (")
        screen.press("1")
        begin(screen)


def control(inside: Namespace, *words: str) -> None:
    """Change the queue of the cable's end: without netem, a slow one loses what does not fit."""
    verb, *rest = words
    subprocess.run([*inside.prefix, "tc", "qdisc", verb, "dev", "line0", *rest], check=True)


def test_cut_cable_of_a_bus_is_named_by_its_slaves(hall: Hall) -> None:
    with hall.top() as screen:
        begin(screen)
        cut = ("sim", "fault", "left/bus0", "cut", "slave=outputs")
        hall.left.command(*cut)
        try:
            screen.wait_for("left/bus0: outputs", "does not answer; the last that answers")
            screen.press("3")
            screen.wait_for("lost", "outputs")
        finally:
            hall.left.command(*cut, "--end")
        screen.press("1")
        begin(screen)


def type_over(screen: Terminal, text: str) -> None:
    """Replace the text of a field, which does not take keys from its first moment on."""
    for _ in range(20):
        screen.press("C-u")
        screen.press("-l", text)
        with suppress(AssertionError):
            screen.wait_for(text[-20:], timeout_s=2)
            return
    raise AssertionError(screen.text())


def test_key_records_the_chosen_station_and_ends_that(hall: Hall) -> None:
    with hall.top("--write", size=LARGE) as screen:
        begin(screen)
        screen.press("r")
        screen.wait_for("Record values of left to FILE.mcap")
        type_over(screen, str(hall.farm.folder / "pressed"))
        screen.press("Enter")
        screen.wait_for("recording 'pressed': ", "The key r ends it.")
        screen.press("Escape")
        # A key right behind it would make one with Alt of both.
        screen.wait_until(lambda text: "The key r ends it." not in text)
        screen.wait_for("recording pressed: recording, ")  # among the details of the station
        screen.press("r")
        screen.wait_for("End recording 'pressed'", "pressed.mcap")
        screen.press("y")
        screen.wait_for("messages, none lost")
    assert describe(hall.farm.folder / "pressed.mcap").finished


def test_killed_appliance_is_waited_for(hall: Hall) -> None:
    plant, runtime = hall.farm.folder / "plant.yaml", hall.left.runtime
    second = hall.farm.write(
        PLANT.replace("hall", "yard").replace("10.88.164", "127.9.64"), "y.yaml"
    )
    assert plant.exists()
    appliance = hall.farm.start(second, "--station", "right", runtime=runtime)
    appliance.wait_ready()
    with hall.top("--plant", "yard") as screen:
        screen.wait_for("yard: 1/1 OP")
        appliance.process.kill()
        appliance.process.wait()
        screen.wait_for("gone", "does not answer", "has ended: waiting for it to run again")
        again = hall.farm.start(second, "--station", "right", runtime=runtime)
        again.wait_ready()
        screen.wait_for("yard: 1/1 OP", "answers again after")
        again.stop()


def test_other_host_sees_the_plant_by_ads_and_may_only_read(hall: Hall) -> None:
    words = [*hall.there.prefix, *EAPCTL, "top", "--connect", HERE, "--once", "--json"]
    words += ["--interval", "0.2"]
    empty = os.environ | {"EAP_RUNTIME_DIR": str(hall.farm.folder / "none")}
    done = subprocess.run(words, env=empty, capture_output=True, text=True, check=True)
    (row,) = map(json.loads, done.stdout.splitlines())
    assert (row["plant"], row["name"], row["state"], row["bus"]) == ("hall", "left", "OP", "4/4 OP")
    assert row["rx_per_s"] > 0
    missing = words.copy()
    missing[missing.index(HERE)] = "10.88.164.77"
    done = subprocess.run(missing, env=empty, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert "10.88.164.77: no AMS router answers" in done.stderr


def test_plain_terminal_gets_lines(hall: Hall) -> None:
    with hall.top("--interval", "0.2", TERM="dumb", size=LARGE) as screen:
        screen.wait_for("hall: 2/2 OP", "Station", "left")


def test_screen_without_colours_shows_the_same(hall: Hall) -> None:
    with hall.top(NO_COLOR="1") as screen:
        begin(screen)
        screen.press("2")
        screen.wait_for("from-right", "running")
        screen.press("q")
        screen.wait_until(lambda text: "from-right" not in text)
