"""``make demo``: run the demo plant and show its variables moving.

The plant runs as ``eapctl run`` would run it; this program only looks at it, with ``eap.attach``,
as any user program may.  On a terminal one screen is redrawn in place, elsewhere it prints a line a
second.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import zip_longest
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from rich.console import Group, RenderableType

import eap
from eap.cli.output import Column, Styled, TextTable, repaint
from eap.errors import EapError
from eap.quantities import duration
from eap.runtime.attach import AttachedStation
from eap.runtime.folder import find_running

PLANT = Path("config/demo.yaml")
EAPCTL = Path(sys.executable).with_name("eapctl")
REFRESH_S = 0.5
LINE_S = 1.0
RATE_OVER_S = 1.0
ENDS_WITHIN_S = 3.0
CELL = 25
"""Columns that a station's variables take."""
CLEAR_SCREEN = "\x1b[2J"


class Shown(NamedTuple):
    """A variable that the screen shows, with a name of its own where that says more."""

    name: str
    unit: str = ""
    title: str = ""

    @property
    def label(self) -> str:
        """Return the name that is shown."""
        return self.title or self.name


class Endpoint(NamedTuple):
    """One PD on its way from the station that sends it to one that receives it."""

    sender: str
    receiver: str
    name: str
    subscription: str

    @property
    def key(self) -> tuple[str, str]:
        """Return the key of its counters in a look."""
        return self.receiver, self.subscription


class Look(NamedTuple):
    """All values and counters at one time: values by station, counters by station and PD."""

    at_s: float
    values: dict[str, dict[str, Any]]
    received: dict[tuple[str, str], dict[str, Any]]


SHOWN = {
    "island-01": (
        Shown("load"),
        Shown("cpu", "%"),
        Shown("ticks"),
        Shown("setpoint", "1/min"),
        Shown("left_position", "mm", "position (03)"),
        Shown("drive_enabled", title="drive"),
    ),
    "island-02": (
        Shown("memory", "KiB"),
        Shown("temperature", "degC"),
        Shown("left_ticks", title="ticks (01)"),
        Shown("left_setpoint", "1/min", "setpoint (01)"),
        Shown("pressure", "bar"),
        Shown("bus0.buttons.limit_switch", title="limit switch"),
    ),
    "island-03": (
        Shown("position", "mm"),
        Shown("running"),
        Shown("left-state.temperature", "degC", "temp. (02)"),
        Shown("left-state.left_setpoint", "1/min", "setpoint (02)"),
        Shown("alarm"),
        Shown("bus0.outputs.out1", title="output 1"),
    ),
}
"""The variables that the screen shows of each station of the demo; in brackets, their origin."""

WAYS = (
    Endpoint("island-01", "island-02", "state", "left-state"),
    Endpoint("island-02", "island-03", "state", "left-state"),
    Endpoint("island-03", "island-01", "state", "left-state"),
    Endpoint("island-03", "island-01", "alarm", "line-alarm"),
    Endpoint("island-03", "island-02", "alarm", "line-alarm"),
)


def main() -> int:
    """Run until Ctrl-C, or for --seconds; return the exit status."""
    parser = argparse.ArgumentParser(description="Run the demo plant and show its values.")
    parser.add_argument("--seconds", type=float, help="end by itself after this time")
    seconds = parser.parse_args().seconds
    os.chdir(Path(__file__).resolve().parent.parent)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with ExitStack() as stack:
        print(
            "make demo: starting three stations on 127.0.1.1, 127.0.1.2 and 127.0.1.3", flush=True
        )
        appliance = stack.enter_context(running(PLANT))
        names = wait_ready(appliance)
        if names is None:
            return appliance.wait()
        try:
            stations = [stack.enter_context(eap.attach(name)) for name in names]
            show(stations, appliance, seconds)
        except KeyboardInterrupt:
            pass
        except EapError as exc:
            print(f"make demo: {exc}", file=sys.stderr)
            return 1
        return appliance.poll() or 0


@contextmanager
def running(plant: Path) -> Iterator[subprocess.Popen[str]]:
    """Start *plant*; at the end ask it to end, and see that it does."""
    command = [str(EAPCTL), "run", str(plant)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as appliance:
        try:
            yield appliance
        finally:
            if appliance.poll() is None:
                appliance.terminate()
            try:
                appliance.wait(ENDS_WITHIN_S)
            except subprocess.TimeoutExpired:
                appliance.kill()


def wait_ready(appliance: subprocess.Popen[str]) -> list[str] | None:
    """Return the names of the stations that run, or None when there will be none."""
    assert appliance.stdout is not None  # noqa: S101  it was asked to be a pipe
    line = appliance.stdout.readline()
    return list(json.loads(line)["stations"]) if line else None


def show(
    stations: list[AttachedStation], appliance: subprocess.Popen[str], seconds: float | None
) -> None:
    """Show what the stations hold until the appliance ends or *seconds* are over."""
    is_terminal = sys.stdout.isatty()
    start = monotonic()
    end = start + seconds if seconds is not None else float("inf")
    meter = RateMeter()
    page = ""
    if is_terminal:
        print(CLEAR_SCREEN, end="")
    while goes_on(appliance, end, REFRESH_S if is_terminal else LINE_S):
        look = read_snapshot(stations, monotonic() - start)
        rates = meter.rates(look)
        if not page and (page := page_text(appliance.pid)) and not is_terminal:
            print(f"make demo: {page}", flush=True)
        if is_terminal:
            repaint([as_screen(look, rates, page)])
        else:
            print(as_line(look, rates), flush=True)


def goes_on(appliance: subprocess.Popen[str], end: float, pause_s: float) -> bool:
    """Wait a moment; return whether the appliance still runs and there is time left."""
    if monotonic() >= end:
        return False
    try:
        appliance.wait(min(pause_s, max(0.0, end - monotonic())))
    except subprocess.TimeoutExpired:
        return True
    return False


def page_text(supervisor: int) -> str:
    """Return the address of the page, or why there is none; empty while it starts."""
    for _, info in find_running():
        web = info.extras.get("web")
        if info.supervisor == supervisor and web is not None:
            if web.fault:
                return f"no page in a browser: {web.fault}"
            if url := web.report.get("url"):
                return f"open {url} in a browser"
    return ""


def read_snapshot(stations: list[AttachedStation], at_s: float) -> Look:
    """Read all values and counters."""
    values = {station.name: station.read_all() for station in stations}
    received = {
        (station.name, row["name"]): row
        for station in stations
        for row in station.status()["pd"]["rx"]
    }
    return Look(at_s, values, received)


class RateMeter:
    """Rates of received PDs, over the last looks of about a second."""

    def __init__(self) -> None:
        self._looks: deque[Look] = deque()

    def rates(self, look: Look) -> dict[Endpoint, float]:
        """Return how many PDs a second came by each way; nothing at the first look."""
        self._looks.append(look)
        while len(self._looks) > 2 and look.at_s - self._looks[1].at_s >= RATE_OVER_S:
            self._looks.popleft()
        before = self._looks[0]
        seconds = look.at_s - before.at_s
        if not seconds:
            return {}
        return {
            way: (look.received[way.key]["received"] - before.received[way.key]["received"])
            / seconds
            for way in WAYS
        }


def as_screen(look: Look, rates: Mapping[Endpoint, float], page: str = "") -> RenderableType:
    """Return stations, their values, and the arrows between them; at most 80 columns, 23 lines."""
    stations = TextTable(*(Column(name, rank=number) for number, name in enumerate(SHOWN)))
    for row in zip_longest(*(cells(look.values[name], SHOWN[name]) for name in SHOWN)):
        stations.add_row(*(cell or "" for cell in row))
    return Group(
        Styled(f"EAP demo: each station pushes its values to the next one{look.at_s:10.0f} s\n"),
        stations,
        Styled(),
        arrows(look, rates),
        Styled(f"\nCtrl-C ends it; {page or 'try in another terminal'}:"[:80], style="dim"),
        Styled("  eapctl status    eapctl pd set island-01 setpoint 75", style="dim"),
    )


def cells(values: Mapping[str, Any], shown: Sequence[Shown]) -> Iterator[str]:
    """Yield name and value of variables, all of the same width."""
    for each in shown:
        value = as_text(values[each.name], each.unit)
        room = CELL - len(value) - 1
        yield f"{each.label[:room]:<{room}} {value}"


def arrows(look: Look, rates: Mapping[Endpoint, float]) -> TextTable:
    """Return a line for each way that PDs take, with its rate and what it lost."""
    table = TextTable(
        "From",
        "",
        "To",
        "Process data",
        Column("Rate", is_number=True),
        Column("Lost", is_number=True),
        Column("Late", is_number=True),
        Column("Age", rank=1, is_number=True),
    )
    for way in WAYS:
        row = look.received[way.key]
        runs = row["state"] == "running"
        rate = f"{rates[way]:.1f}/s" if way in rates else "      "
        table.add_row(
            way.sender,
            Styled("──────►" if runs else "── x ──", style="green" if runs else "bold red"),
            way.receiver,
            f"{way.name:<12}",
            f"{rate:>7}",
            Styled("-" if row["lost"] is None else str(row["lost"]), "red" * bool(row["lost"])),
            str(row["late"]),
            f"{'-' if row['age_us'] is None else duration(row['age_us']):>8}",
        )
    return table


def as_line(look: Look, rates: Mapping[Endpoint, float]) -> str:
    """Return one line of less than 80 columns: rate, losses, and a value on its way."""
    rows = [look.received[way.key] for way in WAYS]
    lost = sum(row["lost"] or 0 for row in rows)
    late = sum(row["late"] for row in rows)
    rate = f"{sum(rates.values()):.0f}" if rates else "-"
    here, there = look.values["island-01"]["ticks"], look.values["island-02"]["left_ticks"]
    return (
        f"{look.at_s:.0f} s: {rate} PDs/s, {lost} lost, {late} late;"
        f" ticks of island-01 {here}, at island-02 {there}"
    )


def as_text(value: Any, unit: str) -> str:
    """Return a value as people read it, in few characters."""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = f"{value:.2f}" if isinstance(value, float) else str(value)
    if unit == "KiB":
        text, unit = f"{value / 1024**2:.1f}", "GiB"
    return f"{text} {unit}".rstrip()


if __name__ == "__main__":
    sys.exit(main())
