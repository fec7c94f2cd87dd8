"""The plant as a bridge sees it: values, writes, and the status of the bridge itself."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from time import time
from typing import Any, Literal

from eap.ams.spec import Role
from eap.bridges.feed import BridgeFeed
from eap.bridges.values import Sample
from eap.control.protocol import WRITE, AnswerT, Method, ParametersT, WriteOrigin
from eap.errors import EapError
from eap.live.client import LiveClient
from eap.runtime.bridges import BridgeFile, BridgeStatus

_REPORT_S = 1.0


class Bridge:
    """The plant, and the status of the bridge.

    Args:
        plant: Name of the plant.
        instance: Name of its appliance: that of the plant, or ``PLANT@STATION+…`` if it runs only
            some of the stations.
        connect: Returns a client of its appliance that is not connected yet.
        ready: Called when the bridge runs.
        file: Where its status goes.
        pid: Its process.

    Attributes:
        plant: Name of the plant.
        instance: Name of the appliance.
        is_ready: True once it has reported that it runs.
        status: Its status; the bridge changes the counters, the file follows once a second.
    """

    def __init__(
        self,
        plant: str,
        instance: str,
        connect: Callable[[], LiveClient],
        *,
        ready: Callable[[], None],
        file: BridgeFile,
        pid: int,
    ) -> None:
        self.plant = plant
        self.instance = instance
        self.status = BridgeStatus(pid=pid, since=time())
        self._connect = connect
        self._writer = connect()
        self._ready = ready
        self.is_ready = False
        self._file = file

    def ready(self) -> None:
        """Report that the bridge runs: it listens, or begins to connect.  Once is enough."""
        if not self.is_ready:
            self.is_ready = True
            self._ready()

    def connected(self, peer: str) -> None:
        """Take note of a connection to *peer* (a URL), or that the bridge listens there."""
        self._change(peer, "", is_up=True)

    def away(self, peer: str, reason: str) -> None:
        """Take note that *peer* is not connected, and why."""
        self._change(peer, reason, is_up=False)

    def feed(
        self,
        patterns: Iterable[str],
        period_ms: int,
        *,
        on_variables: Callable[[], None] = lambda: None,
        on_values: Callable[[Mapping[str, Sample]], None] = lambda _: None,
    ) -> BridgeFeed:
        """Return the values of the variables that *patterns* select; ``run`` it in a task.

        Args:
            patterns: ``STATION/NAME``, with ``*`` for any text without slashes.
            period_ms: Period of values, at least 10.
            on_variables: Called when there are other variables than before.
            on_values: Called with the values that changed, or whose quality did.
        """
        return BridgeFeed(
            self._connect, patterns, period_ms, on_variables=on_variables, on_values=on_values
        )

    async def write(
        self,
        name: str,
        value: Any,
        *,
        transport: Literal["mqtt", "opcua", "s7", "modbus"],
        host: str,
        user: str = "",
        role: Role | None = None,
    ) -> None:
        """Write a variable of the application for a client.

        Args:
            name: ``STATION/NAME``.
            value: Its value in the plain form of :class:`Sample`.
            transport: For access rules and the audit.
            host: Address of the client; of MQTT the topic.
            user: Its user, empty without login.
            role: Of the user.

        Raises:
            EapError: it is refused, or the appliance does not answer; the reason is for the client.
        """
        await self.write_all({name: value}, transport=transport, host=host, user=user, role=role)

    async def write_all(
        self,
        values: Mapping[str, Any],
        *,
        transport: Literal["mqtt", "opcua", "s7", "modbus"],
        host: str,
        user: str = "",
        role: Role | None = None,
    ) -> None:
        """Write several variables as :meth:`write` does; those of one station all or none."""
        by_station: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            station, _, variable = name.partition("/")
            by_station.setdefault(station, {})[variable] = value
        self.status.received += len(values)
        origin = WriteOrigin(user, host, transport=transport, role=role)
        left = len(values)
        try:
            for station, own in by_station.items():
                # The appliance checks all values of a station before it writes the first.
                await self._writer.call(WRITE, station=station, values=own, origin=origin)
                left -= len(own)
        except EapError:
            self.status.refused += left
            raise

    async def request(self, method: str) -> Any:
        """Return the result of a method of the control protocol that needs no parameters.

        Raises:
            EapError: it is refused, or the appliance does not answer.
        """
        return await self._writer.request(method)

    async def call(self, method: Method[ParametersT, AnswerT], /, **params: Any) -> AnswerT:
        """Return the answer to a method of the control protocol; raises as :meth:`request`."""
        return await self._writer.call(method, **params)

    async def report(self) -> None:
        """Keep the file of the status current until cancelled."""
        try:
            while True:
                self._file.write(self.status)
                await asyncio.sleep(_REPORT_S)
        finally:
            self._file.write(self.status)
            await self._writer.close()

    def save(self) -> None:
        """Write the status to its file now, after a change that users wait for."""
        self._file.write(self.status)

    def _change(self, peer: str, reason: str, *, is_up: bool) -> None:
        status = self.status
        if (status.is_up, status.reason, status.peer) != (is_up, reason, peer):
            status.is_up, status.reason, status.peer = is_up, reason, peer
            status.since = time()
            self.save()
