"""Live view of several appliances: their status, taken together, with the events in it.

Appliances of this host are found anew for each report, so that those that start appear and those
that end are reported as gone.  One that does not answer delays no other.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Self

import msgspec
from msgspec.structs import asdict

from eap.control.protocol import ErrorCode
from eap.errors import ControlError, EapError
from eap.live.client import LiveClient
from eap.live.events import EventLog, LiveEvent
from eap.live.findings import StatusReport, findings
from eap.live.rows import StationKey
from eap.live.status import MergedStatus, SilentAppliance
from eap.live.transport import UnixConnection
from eap.runtime.folder import ApplianceInfo, find_running
from eap.services.tasks import TaskSet

ANSWER_S = 1.0
"""Time after which a report does without an appliance that has not answered yet."""


class LiveReport(msgspec.Struct, frozen=True, kw_only=True):
    """Status of all appliances at one time.

    Attributes:
        at_ns: Its time on the monotonic clock.
        time: Its Unix time.
        status: The merged status with its findings; of appliances that do not answer, the last one
            is not in it.
        unreachable: Appliances and hosts that do not answer, with the reason.
        events: Events since the report before.
    """

    at_ns: int
    time: float
    status: StatusReport
    unreachable: dict[str, str]
    events: list[LiveEvent]


class _Source:
    """An appliance of this host, or a remote one, with the status request that is under way."""

    def __init__(self, name: str, client: LiveClient, info: ApplianceInfo | None = None) -> None:
        self.name = name
        self.client = client
        self.info = info
        self.document: dict[str, Any] | None = None
        self.why = ""
        self._tasks = TaskSet(f"status of {name}")
        self._task: asyncio.Task[None] | None = None

    def ask(self) -> asyncio.Task[None]:
        """Return the request under way, which begins now if there is none."""
        if self._task is None or self._task.done():
            self._task = self._tasks.start(self._ask())
        return self._task

    def has_answered(self) -> bool:
        return self._task is not None and self._task.done()

    async def close(self) -> None:
        await self._tasks.close()
        await self.client.close()

    async def _ask(self) -> None:
        try:
            try:
                document = await self.client.request("status")
            except ControlError as exc:
                if exc.code != ErrorCode.UNAVAILABLE:
                    raise
                # Services was restarted since the last request: another connection reaches it.
                document = await self.client.request("status")
            self.document, self.why = document, ""
        except EapError as exc:
            self.document, self.why = None, str(exc)


class LiveView:
    """Appliances of this host, or remote ones.

    Args:
        plant: Only the appliances that run this plant; all if empty.
        remote: Clients of remote appliances by name; without one the appliances of this host are
            shown.
        answer_s: Time after which a report does without an appliance that has not answered yet.

    Attributes:
        log: Events of all reports.
    """

    def __init__(
        self,
        plant: str = "",
        remote: Mapping[str, LiveClient] = {},
        *,
        answer_s: float = ANSWER_S,
    ) -> None:
        self.log = EventLog()
        self._plant = plant
        self._is_local = not remote
        self._answer_s = answer_s
        self._sources = {name: _Source(name, client) for name, client in remote.items()}
        self._ended: dict[str, str] = {}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        sources, self._sources = self._sources, {}
        for source in sources.values():
            await source.close()

    def clients(self) -> dict[str, LiveClient]:
        """Return the clients of the appliances, by source."""
        return {name: source.client for name, source in self._sources.items()}

    def client_of(self, plant: str, station: str) -> LiveClient:
        """Return the client of the appliance that runs a station.

        Raises:
            ControlError: no appliance that answered runs it.
        """
        for source in self._sources.values():
            document = source.document
            if (
                document is not None
                and document["plant"] == plant
                and any(each["name"] == station for each in document["stations"])
            ):
                return source.client
        raise ControlError(f"station {station} of plant {plant} does not run")

    async def take(self, *, within_s: float | None = None) -> LiveReport:
        """Return the present status; never raises EapError.

        Args:
            within_s: Time after which it does without an appliance that has not answered yet;
                that of the view unless given.
        """
        if self._is_local:
            await self._find_local()
        waiting = [source.ask() for source in self._sources.values()]
        if waiting:
            # Not wait_for(): a late request goes on, and its answer is in the next report.
            await asyncio.wait(waiting, timeout=within_s or self._answer_s)
        at_ns, now_s = time.monotonic_ns(), time.time()
        silent = [
            SilentAppliance(info.plant, info.stations, info.services.pid)
            for source in self._sources.values()
            if not source.has_answered() and (info := source.info) is not None
        ]
        unreachable = self._ended | dict(self._unreachable())
        documents = self._documents()
        merged = MergedStatus.of(documents, silent)
        status = StatusReport(**asdict(merged), findings=findings(merged, now_s))
        events = self.log.take(status, at_ns, now_s, unreachable)
        return LiveReport(
            at_ns=at_ns, time=now_s, status=status, unreachable=unreachable, events=events
        )

    def _unreachable(self) -> Iterator[tuple[str, str]]:
        for source in self._sources.values():
            if not source.has_answered():
                yield source.name, source.why or "does not answer"
            elif source.document is None:
                yield source.name, source.why.removeprefix(f"{source.name}: ")

    def _documents(self) -> list[dict[str, Any]]:
        """Return the answers; a station that several sources show is that of the first."""
        # A remote station may be reached by several hosts, of which each shows all of its
        # appliance.
        known: set[StationKey] = set()
        documents = []
        for source in self._sources.values():
            document = source.document
            if document is None or not source.has_answered():
                continue
            if self._plant not in {"", document["plant"]}:
                continue
            keys = [(document["plant"], each["name"]) for each in document["stations"]]
            if keys and known.issuperset(keys):
                continue
            stations = [
                each
                for key, each in zip(keys, document["stations"], strict=True)
                if key not in known
            ]
            known.update(keys)
            documents.append(document | {"stations": stations})
        return documents

    async def _find_local(self) -> None:
        """Follow the appliances of this host: those that start, and those that have ended."""
        found = {
            folder.path.name: (folder, info)
            for folder, info in find_running()
            if not self._plant or info.plant == self._plant
        }
        for name in [each for each in self._sources if each not in found]:
            await self._sources.pop(name).close()
            self._ended[name] = "has ended: waiting for it to run again"
        for name, (folder, info) in found.items():
            self._ended.pop(name, None)
            if name in self._sources:
                self._sources[name].info = info
                continue
            path = folder.control_socket
            self._sources[name] = _Source(
                name, LiveClient(partial(UnixConnection.open, path)), info
            )
