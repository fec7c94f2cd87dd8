"""Changes of variables of any number of running stations, as one stream.

Each station has a connection to itself; more than one are read by a thread each, because whoever
waits for two sockets with one buffered reader misses what the buffer already holds.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from queue import SimpleQueue
from typing import Any

from eap.appliance.commands.client import connect_station
from eap.errors import EapError


def changes(
    stack: ExitStack, names: Mapping[str, Sequence[str]], *, period_ms: int, plant: str | None
) -> Iterator[dict[str, Any]]:
    """Yield one dict for each change of the variables *names* of each station; none means all.

    Keys: station, variable, value, time (ISO 8601), cycle, quality for received variables (in units
    of 100 us, None before the first time), and skipped, if there were cycles since the station's
    change before that nobody has looked at.  Connections are closed by *stack*.

    Raises:
        ControlError: a station or variable is not there, or an appliance went away.
    """
    events = [
        stack.enter_context(connect_station(station, plant)).events(
            station=station, names=list(variables), period_ms=period_ms, on="change"
        )
        for station, variables in names.items()
    ]
    for event in events[0] if len(events) == 1 else _merge(events):
        now = datetime.now().astimezone().isoformat(timespec="milliseconds")
        quality = event.get("quality", {})
        for variable, value in event["values"].items():
            change = {
                "station": event["station"],
                "variable": variable,
                "value": value,
                "time": now,
                "cycle": event["cycle"],
            }
            if variable in quality:
                change["quality"] = quality[variable]
            if event.get("skipped"):
                change["skipped"] = event["skipped"]
            yield change


class SkippedCycles:
    """Cycles that were skipped between the lines of programs, which have no place for that.

    Args:
        period_ms: How often values are looked at.
        write: Takes a line for people.
    """

    def __init__(self, period_ms: int, write: Callable[[str], None]) -> None:
        self._period_ms = period_ms
        self._write = write
        self._last: dict[str, int] = {}
        self._totals: dict[str, int] = {}

    def without(self, write: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
        """Return what writes changes without ``skipped``, and the first of each station's here."""

        def write_change(change: dict[str, Any]) -> None:
            skipped, station, cycle = change.pop("skipped", 0), change["station"], change["cycle"]
            if skipped and self._last.get(station) != cycle:  # else another variable of that event
                if station not in self._totals:
                    self._write(
                        f"{station}: {skipped} cycles before cycle {cycle} skipped: values are"
                        f" looked at every {self._period_ms} ms; choose a shorter --period"
                    )
                self._totals[station] = self._totals.get(station, 0) + skipped
                self._last[station] = cycle
            write(change)

        return write_change

    def close(self) -> None:
        """Write how many cycles of each station were skipped in all."""
        for station, total in self._totals.items():
            self._write(f"{station}: {total} cycles skipped in all")


def _merge(streams: Sequence[Iterator[dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    """Yield what any of *streams* brings, as it comes; the first error ends it."""
    arrivals: SimpleQueue[dict[str, Any] | Exception] = SimpleQueue()

    def forward(stream: Iterator[dict[str, Any]]) -> None:
        try:
            for event in stream:
                arrivals.put(event)
        except (EapError, OSError, ValueError) as exc:  # ValueError: closed at the end
            arrivals.put(exc)

    for stream in streams:
        threading.Thread(target=forward, args=(stream,), daemon=True).start()
    while not isinstance(arrival := arrivals.get(), Exception):
        yield arrival
    raise arrival
