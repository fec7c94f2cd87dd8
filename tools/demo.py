"""``make demo``: run the demo plant and show its variables moving.

The plant runs as ``eapctl run`` would run it; this program only looks at it, with ``eap.attach``,
as any user program may.  On a terminal tables are redrawn, elsewhere a line a station is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table

import eap
from eap.appliance.attach import AttachedStation
from eap.errors import EapError
from eap.pd.layout import FRAME_CTRL, VAR_CTRL

PLANT = Path("config/demo.yaml")
EAPCTL = Path(sys.executable).with_name("eapctl")
REFRESH_S = 0.5
LINE_S = 0.7
ENDS_WITHIN_S = 3.0
VALUE_LENGTH = 32
COLUMN = 42
"""Columns of the terminal that the tables of one station take."""


def main() -> int:
    """Run until Ctrl-C, or for --seconds; return the exit status."""
    parser = argparse.ArgumentParser(description="Run the demo plant and show its values.")
    parser.add_argument("--seconds", type=float, help="end by itself after this time")
    seconds = parser.parse_args().seconds
    os.chdir(Path(__file__).resolve().parent.parent)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with ExitStack() as stack:
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
    console = Console(markup=False)
    end = monotonic() + seconds if seconds is not None else float("inf")
    if not console.is_terminal:
        while goes_on(appliance, end, LINE_S):
            for station in stations:
                print(as_line(station), flush=True)
        return
    with Live(console=console, auto_refresh=False) as live:
        while goes_on(appliance, end, REFRESH_S):
            live.update(as_view(stations, console.width), refresh=True)


def goes_on(appliance: subprocess.Popen[str], end: float, pause_s: float) -> bool:
    """Wait a moment; return whether the appliance still runs and there is time left."""
    if monotonic() >= end:
        return False
    try:
        appliance.wait(min(pause_s, max(0.0, end - monotonic())))
    except subprocess.TimeoutExpired:
        return True
    return False


def as_line(station: AttachedStation) -> str:
    """Write the values of one station, short."""
    values = "  ".join(f"{name}={text}" for name, text in texts(station))
    return f"{station.name} cycle {station.cycle}: {values}"


def as_view(stations: list[AttachedStation], width: int) -> Columns | Group:
    """Lay out tables side by side, or a paragraph a station where the terminal is too narrow."""
    if width < COLUMN * len(stations):
        return Group(*(f"{as_line(station)}\n" for station in stations))
    return Columns([Group(variables(station), subscriptions(station)) for station in stations])


def variables(station: AttachedStation) -> Table:
    """Make the table of a station's values."""
    table = Table(title=f"{station.name}, cycle {station.cycle}")
    table.add_column("variable")
    table.add_column("value", justify="right")
    for row in texts(station):
        table.add_row(*row)
    return table


def subscriptions(station: AttachedStation) -> Table:
    """Make the table of what a station receives."""
    table = Table()
    for name in ("receives", "frames", "lost", "age"):
        table.add_column(name, justify="left" if name == "receives" else "right")
    received: list[dict[str, Any]] = station.status()["pd"]["rx"]
    for pd in received:
        age = "-" if pd["age_us"] is None else f"{pd['age_us'] / 1000:.0f} ms"
        lost = "-" if pd["lost"] is None else str(pd["lost"])
        table.add_row(pd["name"], str(pd["received"]), lost, age)
    return table


def texts(station: AttachedStation) -> Iterator[tuple[str, str]]:
    """Yield the variables that say something to people, as text."""
    for name, value in station.read_all().items():
        if not name.endswith((VAR_CTRL, FRAME_CTRL)):  # bits by which programs hold PDs back
            yield name, as_text(value)


def as_text(value: Any) -> str:
    """Write a value, shortened where it is long."""
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    if isinstance(value, bytes):
        text = value.hex(" ")
    return text if len(text) <= VALUE_LENGTH else f"{text[: VALUE_LENGTH - 1]}…"


if __name__ == "__main__":
    sys.exit(main())
