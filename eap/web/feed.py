"""The plant as the page shows it: status, directory and present values of its stations.

Nothing here raises for a plant that does not answer: values grow old, and say so.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import aclosing
from itertools import islice
from time import monotonic, time
from typing import Any, NamedTuple

import msgspec

from eap.codec.datatypes import variable_of
from eap.config.web import STATE
from eap.control.protocol import (
    PD_LIST,
    READ,
    VARIABLES,
    WRITE,
    ErrorCode,
    ValuesEvent,
    WriteOrigin,
)
from eap.control.routes import ROUTES_LIST, RouterRow
from eap.errors import ControlError, EapError
from eap.live.client import LiveClient
from eap.live.events import LiveEvent
from eap.live.findings import Severity, is_hung
from eap.live.rows import pd_flows, station_rows
from eap.live.transport import ValuesSubscription
from eap.live.view import LiveReport, LiveView
from eap.patterns import match_names
from eap.pd.quality import QUALITY_MAX, QUALITY_NS
from eap.pd.spec import Writer
from eap.suggest import suggest

FAST_MS, SLOW_MS = 100, 1000
"""Periods of values: those that a page shows one by one, and those of tables."""
STATUS_S = 1.0
_DIRECTORY_S = 10.0
_STALE_AFTER_S = 2.0
"""Beyond its period, a value of a station that runs no cycle, or does not answer, is stale."""
_KEPT_EVENTS = 200
_SHOWN_VALUE = 40
"""Characters of a value in an event."""

logger = logging.getLogger(__name__)


class Variable(msgspec.Struct, frozen=True):
    """Variable of the plant, as ``GET /api/v1/variables`` describes it."""

    type: str
    unit: str
    comment: str
    writer: str
    settable: bool


class ShownValue(NamedTuple):
    """Present value of a variable; messages have it as an array.

    Attributes:
        value: As in the control protocol; None while it is unknown.
        age_us: Age of the data; None before the first.
        is_stale: True if it is too old to be relied on.
    """

    value: Any
    age_us: int | None
    is_stale: bool


UNKNOWN = ShownValue(None, None, True)


class GraphLink(msgspec.Struct, frozen=True, kw_only=True):
    """Arrow of the plant's graph: a PD from its sender to one station that receives it.

    *sender* is the station whose port has the publisher's NetID; empty if the plant has none.
    """

    sender: str
    pd: str
    receiver: str
    subscription: str
    publisher: str
    id: int


class _Directory(NamedTuple):
    """Names of one station."""

    variables: dict[str, Variable]
    received: dict[str, frozenset[str]]
    """Variables of each subscription."""
    links: tuple[tuple[str, str, str, int], ...]
    """Of each PD: direction, name, publisher, id."""


class _Sample:
    """Latest values of one station with one period."""

    def __init__(self, period_ms: int) -> None:
        self.period_s = period_ms / 1000
        self.event: ValuesEvent | None = None
        self.at_s = 0.0
        self.cycle_at_s = 0.0

    def take(self, event: ValuesEvent, now_s: float) -> None:
        # A station whose engine hangs still answers, with the cycle of before.
        if self.event is None or self.event.cycle != event.cycle:
            self.cycle_at_s = now_s
        self.event, self.at_s = event, now_s


class PlantFeed:
    """Present knowledge of a plant, for pages and API.

    Args:
        view: The appliances.
        on_status: Called after each status report.
        on_values: Called with a station after its values came.
    """

    def __init__(
        self,
        view: LiveView,
        *,
        on_status: Callable[[], None] = lambda: None,
        on_values: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.report: LiveReport | None = None
        self.plant = ""
        """Name of the plant, empty until it has answered."""
        self.directories: dict[str, _Directory] = {}
        self.directory_version = 0
        self._view = view
        self._reports: deque[LiveReport] = deque(maxlen=3)
        self._stale: dict[str, frozenset[str]] = {}
        self._ages: dict[str, dict[str, int]] = {}
        self._samples: dict[tuple[str, int], _Sample] = {}
        self._wanted: dict[tuple[str, int], frozenset[str]] = {}
        self._watches: dict[tuple[str, int], tuple[object, asyncio.Task[None]]] = {}
        self._group: asyncio.TaskGroup | None = None
        self._on_status = on_status
        self._on_values = on_values

    async def run(self) -> None:
        """Follow the plant until cancelled."""
        async with asyncio.TaskGroup() as group:
            self._group = group
            group.create_task(self._follow_directories())
            while True:
                await self._take_status()
                await asyncio.sleep(STATUS_S)

    def stations(self) -> list[str]:
        """Return the names of the stations that were ever seen."""
        return list(self.directories)

    def events(self, most: int = _KEPT_EVENTS) -> list[LiveEvent]:
        """Return the latest events, the newest last."""
        log = self._view.log.events
        return list(islice(log, max(0, len(log) - most), None))

    def names(self) -> list[str]:
        """Return all variables, ``STATION/NAME``."""
        return [f"{st}/{name}" for st, own in self.directories.items() for name in own.variables]

    def resolve(self, patterns: Iterable[str]) -> list[str]:
        """Return the names that fit *patterns*, in their order, each once.

        A name without ``*`` is itself: it may be of a member, or of a station that is silent.
        """
        known = self.names()
        found: dict[str, None] = {}
        for pattern in patterns:
            if "*" not in pattern:
                found[pattern] = None
                continue
            found |= dict.fromkeys(match_names(pattern, known))
            # The state is in no directory: a pattern for all variables leaves it out.
            states = [f"{station}/{STATE}" for station in self.directories]
            if pattern.endswith(f"/{STATE}"):
                found |= dict.fromkeys(match_names(pattern, states))
        return list(found)

    def describe(self, name: str) -> Variable | None:
        """Return the description of a variable; None of an unknown one, and of a member."""
        station, _, variable = name.partition("/")
        directory = self.directories.get(station)
        return None if directory is None else directory.variables.get(variable)

    def unit_of(self, name: str) -> str:
        """Return the unit of a variable, or of the variable of a member."""
        station, _, variable = name.partition("/")
        if (directory := self.directories.get(station)) is None:
            return ""
        found = directory.variables.get(variable_of(variable, directory.variables))
        return "" if found is None else found.unit

    def want(self, fast: Iterable[str], slow: Iterable[str]) -> None:
        """Have these values kept current, all others not."""
        wanted: dict[tuple[str, int], set[str]] = {}
        # What is read fast is not read a second time slowly.
        for period_ms, names in ((FAST_MS, set(fast)), (SLOW_MS, set(slow) - set(fast))):
            for name in names:
                station, _, variable = name.partition("/")
                if self._is_readable(station, variable):
                    wanted.setdefault((station, period_ms), set()).add(variable)
        self._wanted = {key: frozenset(names) for key, names in wanted.items()}
        self._update_watches()

    def shown(self, name: str, now_s: float) -> ShownValue:
        """Return the present value of a variable that is wanted."""
        station, _, variable = name.partition("/")
        for period_ms in (FAST_MS, SLOW_MS):
            sample = self._samples.get((station, period_ms))
            if sample is None or sample.event is None:
                continue
            if variable in sample.event.values:
                return self._of_sample(station, variable, sample, now_s)
        if variable == STATE and not self._is_readable(station, variable):
            return self._state_of(station)
        return UNKNOWN

    async def read(
        self, station: str, names: list[str]
    ) -> dict[str, tuple[ShownValue, int | None]]:
        """Read variables of a station now; raise ControlError if that fails.

        Returns:
            Value and quality of each; the quality is None unless the variable is received.
        """
        directory = self._known(station)
        states = [name for name in names if name == STATE and STATE not in directory.variables]
        asked = [name for name in names if name not in states]
        found: dict[str, tuple[ShownValue, int | None]] = {
            name: (self._state_of(station), None) for name in states
        }
        if asked:
            client = self._client_of(station)
            values = await client.call(READ, station=station, names=asked)
            sample, now_s = _Sample(FAST_MS), monotonic()
            sample.take(ValuesEvent(**msgspec.structs.asdict(values)), now_s)
            for name in asked:
                shown = self._of_sample(station, name, sample, now_s)
                found[name] = shown, values.quality.get(name)
        return {f"{station}/{name}": found[name] for name in names}

    async def write(self, station: str, variable: str, value: Any, origin: WriteOrigin) -> None:
        """Write a variable of the application; raise ControlError if that is refused."""
        client = self._client_of(station)
        await client.call(WRITE, station=station, values={variable: value}, origin=origin)

    def note_write(self, name: str, value: Any, origin: WriteOrigin) -> None:
        """Add a value that a user has set to the events."""
        text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
        what = f"set to {text[:_SHOWN_VALUE]} {self.unit_of(name)}".rstrip()
        what += f" by {origin.user or origin.host}"
        if origin.comment:
            what += f": {origin.comment}"
        events = self._view.log.events
        events.append(LiveEvent(time(), Severity.INFO, self.plant, name, what))

    async def routes(self, station: str) -> list[RouterRow]:
        """Return the routes of a station; raise ControlError if it does not answer."""
        return await self._client_of(station).call(ROUTES_LIST, station=station)

    def links(self) -> list[GraphLink]:
        """Return the process data between the stations."""
        sent = {
            (publisher, number): (station, name)
            for station, directory in self.directories.items()
            for direction, name, publisher, number in directory.links
            if direction == "tx"
        }
        links = []
        for station, directory in self.directories.items():
            for direction, name, publisher, number in directory.links:
                if direction != "rx":
                    continue
                sender, pd = sent.get((publisher, number), ("", ""))
                links.append(
                    GraphLink(
                        sender=sender,
                        pd=pd,
                        receiver=station,
                        subscription=name,
                        publisher=publisher,
                        id=number,
                    )
                )
        return links

    def overview(self) -> dict[str, Any]:
        """Return the message of topic ``plant`` without its head."""
        report = self.report
        if report is None:
            return {"stations": [], "flows": [], "links": [], "buses": {}, "findings": []}
        before = self._reports[0] if len(self._reports) > 1 else None
        now, earlier = report.status, None if before is None else before.status
        return {
            "plant": self.plant,
            "stations": station_rows(now, earlier),
            "flows": pd_flows(now, earlier),
            "links": self.links(),
            "buses": {
                f"{station['name']}/{port['name']}": port["bus"]
                for station in now.stations
                for port in station["ports"]
                if port.get("bus") is not None
            },
            "findings": now.findings,
            "unreachable": report.unreachable,
        }

    def _known(self, station: str) -> _Directory:
        try:
            return self.directories[station]
        except KeyError:
            reason = f"unknown station {station!r}{suggest(station, self.directories)}"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None

    def _client_of(self, station: str) -> LiveClient:
        self._known(station)
        report = self.report
        for row in report.status.stations if report else ():
            if row["name"] == station:
                return self._view.client_of(row["plant"], station)
        raise ControlError(f"station {station} does not answer", code=ErrorCode.UNAVAILABLE)

    def _is_readable(self, station: str, variable: str) -> bool:
        directory = self.directories.get(station)
        if directory is None:
            return False
        # A subscription with one unknown name would be refused as a whole.
        return variable_of(variable, directory.variables) in directory.variables

    def _state_of(self, station: str) -> ShownValue:
        report = self.report
        for row in report.status.stations if report else ():
            if row["name"] == station:
                return ShownValue(row["state"], row.get("cycle_age_us"), is_hung(row))
        return UNKNOWN

    def _of_sample(self, station: str, variable: str, sample: _Sample, now_s: float) -> ShownValue:
        assert sample.event is not None  # noqa: S101  the callers have looked
        silent_s = now_s - sample.at_s
        still_s = now_s - sample.cycle_at_s
        is_stale = still_s > sample.period_s + _STALE_AFTER_S
        value = sample.event.values.get(variable)
        # Only what is received has a quality; other values are as old as their cycle.
        if variable not in sample.event.quality:
            return ShownValue(value, int(still_s * 1e6), is_stale)
        quality = sample.event.quality[variable]
        if quality is None:
            return ShownValue(value, None, True)
        age_us = quality * QUALITY_NS // 1000 + int(silent_s * 1e6)
        directory = self.directories.get(station)
        whole = variable_of(variable, directory.variables) if directory else variable
        if quality == QUALITY_MAX:  # saturated: the age of the last PD says more
            age_us = max(age_us, self._ages.get(station, {}).get(whole, 0))
        return ShownValue(value, age_us, is_stale or whole in self._stale.get(station, ()))

    async def _take_status(self) -> None:
        self.report = report = await self._view.take()
        self._reports.append(report)
        if report.status.appliances:
            self.plant = report.status.appliances[0].plant
        for row in report.status.stations:
            directory = self.directories.get(row["name"])
            if directory is None:
                continue
            received = directory.received
            stale = [
                name
                for pd in row["pd"]["rx"]
                if pd["state"] != "running"
                for name in received.get(pd["name"], ())
            ]
            self._stale[row["name"]] = frozenset(stale)
            self._ages[row["name"]] = {
                name: pd["age_us"]
                for pd in row["pd"]["rx"]
                if pd["age_us"] is not None
                for name in received.get(pd["name"], ())
            }
        self._update_watches()
        self._on_status()

    async def _follow_directories(self) -> None:
        while True:
            report = self.report
            for row in report.status.stations if report else ():
                await self._read_directory(row["name"])
            # Pages have nothing to show before the first directory.
            await asyncio.sleep(_DIRECTORY_S if self.directories else 0.1)

    async def _read_directory(self, station: str) -> None:
        try:
            report = self.report
            plants = {row["name"]: row["plant"] for row in report.status.stations} if report else {}
            client = self._view.client_of(plants.get(station, ""), station)
            variables = await client.call(VARIABLES, station=station)
            pds = await client.call(PD_LIST, station=station)
        except EapError as exc:
            logger.debug("variables of %s: %s", station, exc)
            return
        found = _Directory(
            {
                row.name: Variable(
                    row.type, row.unit, row.comment, row.writer, row.writer == Writer.APPLICATION
                )
                for row in variables
            },
            {
                row.name: frozenset(each.name for each in row.variables)
                for row in pds
                if row.direction == "rx"
            },
            tuple((row.direction, row.name, row.publisher or "", row.id) for row in pds),
        )
        if self.directories.get(station) != found:
            self.directories[station] = found
            self.directory_version += 1

    def _update_watches(self) -> None:
        """Start, exchange and end the subscriptions so that they are those that are wanted."""
        if self._group is None:
            return
        for key in [key for key in self._watches if key not in self._wanted]:
            self._watches.pop(key)[1].cancel()
            # Values that are no longer read grow old, and must not be shown when a page wants them
            # again.
            self._samples.pop(key, None)
        for key, names in self._wanted.items():
            try:
                client = self._client_of(key[0])
            except ControlError:
                continue  # the last values grow old until it answers again
            running = self._watches.get(key)
            identity = (client, names)
            if running is not None and running[0] == identity and not running[1].done():
                continue
            if running is not None:
                running[1].cancel()
            task = self._group.create_task(self._watch(client, *key, names))
            self._watches[key] = identity, task

    async def _watch(
        self, client: LiveClient, station: str, period_ms: int, names: frozenset[str]
    ) -> None:
        sample = self._samples.setdefault((station, period_ms), _Sample(period_ms))
        wanted = ValuesSubscription(
            station=station, names=tuple(sorted(names)), period_ms=period_ms
        )
        async with aclosing(client.watch(wanted)) as events:
            async for event in events:
                if isinstance(event, ValuesEvent):
                    sample.take(event, monotonic())
                    self._on_values(station)
                    continue
                logger.debug("values of %s: %s", station, event)
                if event.code == ErrorCode.UNKNOWN_NAME:
                    # Configured anew: without the variables that are gone the others are readable.
                    await self._read_directory(station)
                    return
