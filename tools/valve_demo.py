"""``make valve``: a limit switch on one station's bus opens a valve on another station's bus.

Two appliances run config/valve.yaml, a station each.  This program moves the switch at the
simulated slave, watches in the process images how that gets to the valve and back through EAP, and
asks the valve's slave itself.  Then it kills the engine of the station with the switch: the valve
has to close by its substitute, and to open again when that engine is back.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from statistics import median
from time import monotonic_ns
from typing import NamedTuple

import eap
from eap.appliance.attach import AttachedStation
from eap.appliance.runtime import VARIABLE
from eap.errors import EapError
from eap.net.ticker import Ticker

PLANT = Path(__file__).resolve().parent.parent / "config" / "valve.yaml"
EAPCTL = Path(sys.executable).with_name("eapctl")
LEFT, RIGHT = "left", "right"
SWITCH = ("left/bus0", "buttons", "limit_switch")
VALVE = ("right/bus0", "valves", "0x7000:1")
TIMEOUT_MS = 50
"""After so long without news the valve closes; the plant file says so."""
OP = 8
_LOOK_NS = 100_000
_UP_WITHIN_S = 15.0
_MOVES_WITHIN_S = 2.0
_BACK_WITHIN_S = 10.0
_MS = 1_000_000


class Point(NamedTuple):
    """A place that a signal passes: a variable of a station, and what it is to people."""

    station: str
    variable: str
    what: str


CHAIN = (
    Point(LEFT, "bus0.buttons.limit_switch", "the switch, in left's process image"),
    Point(RIGHT, "bus0.valves.valve", "the valve's output, in right's process image"),
    Point(RIGHT, "bus0.valves.feedback", "the valve itself, as its slave reports"),
    Point(LEFT, "bus0.buttons.lamp", "the lamp at left, through EAP"),
)
OUTPUT, FEEDBACK, LAMP = CHAIN[1:]


class DemoError(Exception):
    """Something did not happen that should have; the message says what."""


class Plant:
    """Both stations as a user program sees them, and the commands that a person has."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._appliances = {name: self._start(name) for name in (LEFT, RIGHT)}
        for name, appliance in self._appliances.items():
            if not _line(appliance):
                raise DemoError(f"eapctl run --station {name} did not start: see above")
        self._stations = {name: stack.enter_context(eap.attach(name)) for name in self._appliances}
        self._ticker = Ticker()
        stack.callback(self._ticker.close)
        self.cycle_ms = self._stations[LEFT].cycle_s * 1000

    def read(self, point: Point) -> bool:
        """Return what is there now."""
        return bool(self._stations[point.station][point.variable])

    def wait(self, condition: Callable[[], bool], within_s: float, what: str) -> int:
        """Wait until *condition* holds; return the time.  Raises DemoError if it never does."""
        end_ns = monotonic_ns() + int(within_s * 1e9)
        while not condition():
            now_ns = monotonic_ns()
            if now_ns > end_ns:
                raise DemoError(f"{what}: not within {within_s:g} s")
            self._ticker.wait(now_ns + _LOOK_NS)
        return monotonic_ns()

    def wait_operational(self) -> None:
        """Wait until all slaves of both buses are in OP."""
        for name, station in self._stations.items():
            up = partial(_is_up, station)
            self.wait(up, _UP_WITHIN_S, f"all slaves of {name}/bus0 in OP")

    def move_switch(self, *, on: bool) -> list[int]:
        """Move the switch at its slave; return when that was seen at each point of the chain."""
        mover = subprocess.Popen(_command("sim", "set", *SWITCH, str(on).lower()))
        try:
            return [self._wait_for(point, on=on) for point in CHAIN]
        finally:
            if mover.wait(_MOVES_WITHIN_S):
                raise DemoError("eapctl sim set was refused: see above")

    def _wait_for(self, point: Point, *, on: bool) -> int:
        return self.wait(lambda: self.read(point) is on, _MOVES_WITHIN_S, point.what)

    def ask_valve(self) -> str:
        """Ask the valve's slave by SDO; return what ``eapctl`` prints."""
        return _say("bus", "sdo", "read", *VALVE)

    def kill_engine(self, name: str) -> int:
        """Kill the engine of a station as a crash would; return when."""
        status = json.loads(_say("status", "--station", name, "--json"))
        os.kill(status["processes"]["engine"]["pid"], signal.SIGKILL)
        return monotonic_ns()

    def _start(self, name: str) -> subprocess.Popen[str]:
        command = [str(EAPCTL), "run", str(PLANT), "--station", name]
        appliance = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._stack.callback(_end, appliance)
        return appliance


def main(arguments: Sequence[str]) -> int:
    """Show it; return 0 if everything happened as it should."""
    parser = argparse.ArgumentParser(description="A limit switch opens a valve, through EAP.")
    parser.add_argument("--moves", type=int, default=6, help="how often the switch moves")
    moves = parser.parse_args(arguments).moves
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="eap-valve-"))
        os.environ[VARIABLE] = folder
        try:
            plant = Plant(stack)
            show_moves(plant, moves)
            show_substitute(plant)
        except (DemoError, EapError) as exc:
            print(f"make valve: {exc}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            return 130
    return 0


def show_moves(plant: Plant, moves: int) -> None:
    """Move the switch to and fro, and say how long it took to each point."""
    begin_ns = monotonic_ns()
    plant.wait_operational()
    _tell(f"all slaves of both buses are in OP, after {_ms(monotonic_ns() - begin_ns)}")
    _tell(f"cycle {plant.cycle_ms:g} ms; times count from {CHAIN[0].what}")
    took_ns = []
    for number in range(moves):
        is_on = not number % 2
        at_ns = plant.move_switch(on=is_on)
        took_ns.append(at_ns[2] - at_ns[0])
        cycles = (at_ns[2] - at_ns[0]) / _MS / plant.cycle_ms
        _tell(
            f"switch {_on(is_on)}: valve {_open(is_on)}"
            f" after {_ms(at_ns[2] - at_ns[0])} ({cycles:.1f} cycles;"
            f" output {_ms(at_ns[1] - at_ns[0])}), lamp at left {_ms(at_ns[3] - at_ns[0])}"
        )
        _tell(f"  the slave of the valve says {plant.ask_valve()}")
    middle_ns = int(median(took_ns))
    _tell(f"from switch to valve: median {_ms(middle_ns)}, longest {_ms(max(took_ns))}")


def show_substitute(plant: Plant) -> None:
    """Kill the engine at the switch; the valve has to close, and to open when it is back."""
    plant.move_switch(on=True)
    killed_ns = plant.kill_engine(LEFT)
    _tell("switch on: valve open; the engine of left is killed")
    closed_ns = plant.wait(lambda: not plant.read(FEEDBACK), _MOVES_WITHIN_S, "the valve closed")
    _tell(f"valve closed by the substitute, {_ms(closed_ns - killed_ns)} later")
    _tell(f"  time-out {TIMEOUT_MS} ms; the slave of the valve says {plant.ask_valve()}")
    open_ns = plant.wait(lambda: plant.read(FEEDBACK), _BACK_WITHIN_S, "the valve open again")
    _tell(f"the engine of left is back: valve open, {_ms(open_ns - killed_ns)} after the kill")
    plant.wait(lambda: plant.read(LAMP), _BACK_WITHIN_S, LAMP.what)
    plant.move_switch(on=False)
    _tell("switch off: valve closed")


def _is_up(station: AttachedStation) -> bool:
    return bool(station["bus0.state"] == OP)


def _command(*words: str) -> list[str]:
    return [str(EAPCTL), *words]


def _say(*words: str) -> str:
    done = subprocess.run(_command(*words), capture_output=True, text=True, check=False)
    if done.returncode:
        raise DemoError(f"eapctl {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout.strip()


def _line(appliance: subprocess.Popen[str]) -> str:
    assert appliance.stdout is not None  # noqa: S101  it was asked to be a pipe
    return appliance.stdout.readline()


def _end(appliance: subprocess.Popen[str]) -> None:
    appliance.terminate()
    try:
        appliance.communicate(timeout=_MOVES_WITHIN_S + 1)
    except subprocess.TimeoutExpired:
        appliance.kill()
        appliance.communicate()


def _tell(text: str) -> None:
    print(text, flush=True)


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / _MS:.1f} ms"


def _on(value: bool) -> str:
    return "on" if value else "off"


def _open(value: bool) -> str:
    return "open" if value else "closed"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
