"""``make valve``: a limit switch on one station's bus opens a valve on another station's bus.

Two appliances run config/valve.yaml, a station each.  This program moves the switch at the
simulated slave, watches in the process images how that gets to the valve and back through EAP, and
asks the valve's slave itself.  Then it kills the engine of the station with the switch: the valve
has to close by its substitute, and to open again when that engine is back.  At last the valve's
slave loses its power for half a second.

Nothing here is a matter of time: every step waits for what has to be true after it, however slow
the machine is.  Where something would pass by itself (an engine that is started again, a power
fault that ends), it is held until it was seen.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from statistics import median
from time import monotonic_ns
from typing import NamedTuple

import eap
from devicebus.mailbox.coe_client import upload
from eap.errors import EapError
from eap.ids import ObjectId
from eap.net.ticker import Ticker
from eap.ops.bus_running import open_running
from eap.runtime.attach import AttachedStation
from eap.runtime.folder import VARIABLE

PLANT = Path(__file__).resolve().parent.parent / "config" / "valve.yaml"
EAPCTL = Path(sys.executable).with_name("eapctl")
LEFT, RIGHT = "left", "right"
BUS = "bus0"
SWITCH = (f"{LEFT}/{BUS}", "buttons", "limit_switch")
VALVE, VALVE_ENTRY = "valves", (0x7000, 1)
TIMEOUT_MS = 50
"""After so long without news the valve closes; the plant file says so."""
OP = 8
_POWER_MS = 500
_LOOK_NS = 100_000
_WITHIN_S = 120.0
"""Limit of every wait: far beyond what a busy machine needs, so that only a fault reaches it."""
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
    """An expected event did not happen; the message names it."""


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

    def wait(self, condition: Callable[[], bool], what: str) -> int:
        """Wait until *condition* holds; return the time.  Raises DemoError if it never does."""
        end_ns = monotonic_ns() + int(_WITHIN_S * 1e9)
        while not condition():
            now_ns = monotonic_ns()
            if now_ns > end_ns:
                raise DemoError(f"{what}: not within {_WITHIN_S:g} s")
            self._ticker.wait(now_ns + _LOOK_NS)
        return monotonic_ns()

    def times(self, duration_ns: int) -> str:
        """Write a duration in milliseconds and cycles."""
        return f"{_ms(duration_ns)}, {duration_ns / _MS / self.cycle_ms:.1f} cycles"

    def wait_operational(self) -> None:
        """Wait until all slaves of both buses are in OP."""
        for name, station in self._stations.items():
            up = partial(_is_up, station)
            self.wait(up, f"all slaves of {name}/bus0 in OP")

    def move_switch(self, *, on: bool) -> list[int]:
        """Move the switch at its slave; return when that was seen at each point of the chain."""
        with _doing("sim", "set", *SWITCH, str(on).lower()):
            return [self._wait_for(point, on=on) for point in CHAIN]

    def ask_valve(self, *, is_open: bool) -> None:
        """Ask the slave of the valve itself, as ``eapctl bus sdo read`` does, and print that.

        It is asked until it says what is expected: on a busy machine the valve may have closed in
        between, because no PD came for 50 ms.
        """
        answer = ""

        def agrees() -> bool:
            nonlocal answer
            try:
                answer = _read_valve()
            except EapError as exc:
                answer = str(exc)
            return answer == f"{is_open:d}"

        entry = str(ObjectId(*VALVE_ENTRY))
        try:
            self.wait(agrees, f"its slave says {entry} = {is_open:d}")
        except DemoError as exc:
            raise DemoError(f"{exc}; its last answer: {answer}") from None
        _tell(f"    its slave says {entry} = {answer}")

    def cut_power(self, for_ms: int) -> tuple[int, int]:
        """Take the power from the slave of the valve for *for_ms*, and until that was seen.

        Return when the power was back, and when the slave was in OP again.
        """
        fault = ("sim", "fault", f"{RIGHT}/{BUS}", "power", f"slave={VALVE}")
        with _doing(*fault):
            lost_ns = self._wait_for_state(0)
        self._ticker.wait(lost_ns + for_ms * _MS)
        with _doing(*fault, "--end"):
            back_ns = self.wait(lambda: self._state() != 0, "the slave answers again")
        return back_ns, self._wait_for_state(OP)

    def _wait_for(self, point: Point, *, on: bool) -> int:
        return self.wait(lambda: self.read(point) is on, point.what)

    def _state(self) -> int:
        return int(self._stations[RIGHT][f"{BUS}.{VALVE}.state"])

    def _wait_for_state(self, state: int) -> int:
        return self.wait(lambda: self._state() == state, f"{BUS}.{VALVE}.state = {state}")

    @contextmanager
    def without_engine(self, name: str) -> Iterator[int]:
        """Kill the engine of a station as a crash would; give the time.

        The supervisor is held for the length of the block, so that it starts the next engine when
        the plant without one has been looked at.
        """
        status = json.loads(_say("status", "--station", name, "--json"))
        supervisor = self._appliances[name]
        supervisor.send_signal(signal.SIGSTOP)
        try:
            os.kill(status["processes"]["engine"]["pid"], signal.SIGKILL)
            yield monotonic_ns()
        finally:
            supervisor.send_signal(signal.SIGCONT)

    def _start(self, name: str) -> subprocess.Popen[str]:
        command = [str(EAPCTL), "run", str(PLANT), "--station", name]
        appliance = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self._stack.callback(_end, appliance)
        return appliance


def main(arguments: Sequence[str]) -> int:
    """Show it; return 0 if everything happened as it should."""
    parser = argparse.ArgumentParser(description="A limit switch opens a valve, through EAP.")
    parser.add_argument("--moves", type=int, default=4, help="how often the switch moves")
    moves = parser.parse_args(arguments).moves
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="eap-valve-"))
        os.environ[VARIABLE] = folder
        try:
            plant = Plant(stack)
            show_moves(plant, moves)
            show_substitute(plant)
            show_power(plant)
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
    _tell(
        f"all slaves of both buses are in OP, {_ms(monotonic_ns() - begin_ns)} after the ready line"
    )
    _tell(f"cycle {plant.cycle_ms:g} ms; times count from the switch in the process image of left")
    took = []
    for number in range(moves):
        is_on = not number % 2
        switch_ns, *others_ns = plant.move_switch(on=is_on)
        after_ns = [each_ns - switch_ns for each_ns in others_ns]
        took.append(after_ns)
        _tell(f"    output to the valve {_on(is_on)}: {plant.times(after_ns[0])}")
        _tell(f"    its contact says {_open(is_on)}: {plant.times(after_ns[1])}")
        _tell(f"    lamp at left {_on(is_on)}: {plant.times(after_ns[2])}")
        plant.ask_valve(is_open=is_on)
    output, contact, _ = (plant.times(int(median(column))) for column in zip(*took, strict=True))
    _tell(f"from the switch to the valve: {output}; until its contact is known at right: {contact}")


def show_substitute(plant: Plant) -> None:
    """Kill the engine at the switch; the valve has to close, and to open when it is back."""
    plant.move_switch(on=True)
    plant.ask_valve(is_open=True)
    with plant.without_engine(LEFT) as killed_ns:
        _tell(f"the engine of left is killed; right waits {TIMEOUT_MS} ms for news")
        closed_ns = plant.wait(lambda: not plant.read(FEEDBACK), "the valve closed")
        _tell(f"    valve closed by the substitute: {_ms(closed_ns - killed_ns)}")
        plant.ask_valve(is_open=False)
        started_ns = monotonic_ns()
    open_ns = plant.wait(lambda: plant.read(FEEDBACK), "the valve open again")
    _tell(f"    the engine is started again, valve open: {_ms(open_ns - started_ns)}")
    plant.wait(lambda: plant.read(LAMP), LAMP.what)
    plant.ask_valve(is_open=True)


def show_power(plant: Plant) -> None:
    """Take the power from the valve's slave; it has to come back, and to open the valve again."""
    answers_ns, operational_ns = plant.cut_power(_POWER_MS)
    _tell(f"    its slave answers again, and is in OP {_ms(operational_ns - answers_ns)} later")
    plant.wait(lambda: plant.read(FEEDBACK), FEEDBACK.what)
    plant.ask_valve(is_open=True)
    plant.move_switch(on=False)
    plant.ask_valve(is_open=False)


@contextmanager
def _doing(*words: str) -> Iterator[None]:
    """Run a command while the block watches what it does; raise DemoError if it is refused."""
    _tell(f"$ eapctl {' '.join(words)}")
    with subprocess.Popen(
        _command(*words), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        yield
        _, refusal = process.communicate(timeout=_WITHIN_S)
    if process.returncode:
        raise DemoError(refusal.strip())


def _read_valve() -> str:
    """Read the output of the valve by CoE; raise EapError."""
    with open_running(RIGHT, BUS) as bus:
        slave = bus.find(VALVE)
        octets = bus.converse(slave, lambda sizes: upload(*VALVE_ENTRY), "the valve")
    return str(octets[0])


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
        appliance.communicate(timeout=_WITHIN_S)
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
