"""Changes of variables of any number of running stations, as one stream.

Each station has a connection to itself; more than one are read by a thread each, because whoever
waits for two sockets with one buffered reader misses what the buffer already holds.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
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

    Keys: station, variable, value, time (ISO 8601), cycle, and quality for received variables (in
    units of 100 us, None before the first time).  Connections are closed by *stack*.

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
            yield change


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
