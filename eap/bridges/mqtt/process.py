"""The bridge to an MQTT broker as a process: connections, values, commands."""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import Callable, Mapping
from time import time_ns

from msgspec.structs import replace

from eap.ams.spec import MqttSpec
from eap.bridges.bridge import Bridge
from eap.bridges.feed import BridgeFeed
from eap.bridges.mqtt.json_values import JsonValues
from eap.bridges.mqtt.sparkplug_node import SparkplugNode
from eap.bridges.mqtt.topics import CommandError, MessageCore, WriteCommand, level
from eap.bridges.process import run_bridge
from eap.bridges.values import Sample
from eap.config.bridge_sections import MqttBridgeSpec
from eap.errors import EapError
from eap.net.mqtt import Handlers, MqttLink
from eap.runtime.startup import Startup

_ROOM = 256
"""Messages that wait for the broker; what else waits is replaced by newer values."""
_MAX_COMMANDS = 64
_WARNED_EVERY_S = 60.0

_ERRNO = re.compile(r"\[Errno \d+\] ")

logger = logging.getLogger(__name__)


def main(descriptor: int, startup: Startup) -> int:
    """Pass values of an appliance to a broker, and commands back."""
    return run_bridge(descriptor, startup, MqttBridgeSpec, serve)


async def serve(bridge: Bridge, spec: MqttBridgeSpec) -> None:
    """Run the connections of a bridge until cancelled."""
    section = spec.section
    cores: dict[str, MessageCore] = {}
    if section.has_json:
        cores["values"] = JsonValues(section, bridge.plant, bridge.instance)
    if section.sparkplug is not None:
        cores["sparkplug"] = SparkplugNode(section, section.sparkplug, bridge.instance)
    patterns = [pattern for each in section.publish for pattern in each.patterns]
    connections: list[BrokerConnection] = []

    def take(samples: Mapping[str, Sample]) -> None:
        for each in connections:
            each.put(samples)

    def take_variables() -> None:
        for each in connections:
            each.set_variables()

    feed = bridge.feed(
        (*patterns, *section.commands),
        section.period_ms,
        on_variables=take_variables,
        on_values=take,
    )
    states = ConnectionStates(bridge, spec.broker)
    for kind, core in cores.items():
        name = section.client_id or f"eap-{level(bridge.instance)}-{level(socket.gethostname())}"
        # A broker ends the older of two connections with one client ID.
        is_only = section.client_id and len(cores) == 1
        client_id = name if is_only else f"{name}-{kind}"
        broker = replace(spec.broker, client_id=client_id)
        report = states.reporter(kind)
        connections.append(BrokerConnection(broker, core, bridge, feed, report))
    bridge.ready()
    async with asyncio.TaskGroup() as group:
        group.create_task(feed.run())
        for connection in connections:
            group.create_task(connection.run(section.period_ms / 1000))


class ConnectionStates:
    """State of the connections to one broker, as one for ``status``."""

    def __init__(self, bridge: Bridge, broker: MqttSpec) -> None:
        self._bridge = bridge
        self._peer = f"mqtt{'s' if broker.tls else ''}://{broker.host}:{broker.port}"
        self._reasons: dict[str, str] = {}
        bridge.away(self._peer, "")

    def reporter(self, kind: str) -> Callable[[str], None]:
        """Return the function that reports why one connection is lost, empty if it is there."""
        self._reasons[kind] = "not connected yet"

        def report(reason: str) -> None:
            self._reasons[kind] = _ERRNO.sub("", reason)
            self._update()

        return report

    def _update(self) -> None:
        if reason := next(filter(None, self._reasons.values()), ""):
            self._bridge.away(self._peer, reason)
        else:
            self._bridge.connected(self._peer)


class BrokerConnection:
    """One connection to a broker: its core's messages, and the commands that it receives.

    Args:
        spec: The broker.
        core: Decides on messages.
        bridge: The plant.
        feed: Its values.
        report: Called with the reason that there is no connection, empty while there is one.
    """

    def __init__(
        self,
        spec: MqttSpec,
        core: MessageCore,
        bridge: Bridge,
        feed: BridgeFeed,
        report: Callable[[str], None],
    ) -> None:
        self._core = core
        self._bridge = bridge
        self._feed = feed
        self._report = report
        self._has_news = asyncio.Event()
        self._commands: asyncio.Queue[WriteCommand] = asyncio.Queue(_MAX_COMMANDS)
        self._warned_at_s = float("-inf")
        handlers = Handlers(
            self._connected, self._lost, self._receive, self._overrun, self._drained
        )
        self._link = MqttLink(spec, spec.client_id, will=core.will, handlers=handlers)
        self._is_connected = False

    def put(self, samples: Mapping[str, Sample]) -> None:
        """Take values that changed."""
        self._bridge.status.dropped += self._core.put(samples)
        self._has_news.set()

    def set_variables(self) -> None:
        """Take the variables of the feed."""
        self._core.set_variables(self._feed.variables, time_ns())
        self._has_news.set()

    async def run(self, period_s: float) -> None:
        """Keep the connection until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._link.run())
            group.create_task(self._execute())
            group.create_task(self._tick(period_s))
            while True:
                await self._has_news.wait()
                self._has_news.clear()
                self._send()

    async def _tick(self, period_s: float) -> None:
        """Have values published that are due by their period."""
        while True:
            # The link keeps the reason of attempts that fail, too.
            self._report("" if self._is_connected else self._link.reason or "not connected yet")
            self._bridge.status.dropped += self._core.put_due(self._feed.samples, time_ns())
            self._has_news.set()
            await asyncio.sleep(period_s)

    def _send(self) -> None:
        # Values wait in the core, where a newer one replaces them, and not in the queue of the
        # link.
        room = _ROOM - self._link.waiting
        if room <= 0:
            return
        messages, count = self._core.messages(room, time_ns())
        for message in messages:
            self._link.send(message)
        self._bridge.status.sent += count

    def _connected(self) -> None:
        self._is_connected = True
        self._core.connected(self._feed.samples, time_ns())
        self._has_news.set()

    def _lost(self, reason: str) -> None:
        del reason  # the link keeps it
        self._is_connected = False
        self._core.disconnected()

    def _receive(self, topic: str, payload: bytes, is_retained: bool) -> None:
        status = self._bridge.status
        try:
            commands = self._core.receive(topic, payload, time_ns(), is_retained=is_retained)
        except CommandError as exc:
            status.received += 1
            status.refused += 1
            self._warn(str(exc))
            if exc.command is not None:
                self._answer(exc.command, str(exc))
            return
        for command in commands:
            try:
                # The link must not wait: it also keeps the connection alive.
                self._commands.put_nowait(command)
            except asyncio.QueueFull:
                status.received += 1
                status.refused += 1
                self._answer(command, f"more than {_MAX_COMMANDS} commands wait")
        self._has_news.set()  # a rebirth

    async def _execute(self) -> None:
        while True:
            command = await self._commands.get()
            error = ""
            try:
                await self._bridge.write(
                    command.name, command.value, transport="mqtt", host=command.topic
                )
            except EapError as exc:
                error = str(exc)
                self._warn(f"{command.name}: {error}")
            self._answer(command, error)

    def _answer(self, command: WriteCommand, error: str) -> None:
        if (message := self._core.answer(command, error, time_ns())) is not None:
            self._link.send(message)

    def _drained(self) -> None:
        if self._core.has_waiting:
            self._has_news.set()

    def _overrun(self) -> None:
        self._bridge.status.received += 1
        self._bridge.status.refused += 1
        self._warn("commands come faster than they are read; some are dropped")

    def _warn(self, reason: str) -> None:
        """Log the reason of a refusal, at most one a minute: clients may send any number."""
        now_s = asyncio.get_running_loop().time()
        if now_s - self._warned_at_s >= _WARNED_EVERY_S:
            self._warned_at_s = now_s
            logger.warning("command refused: %s", reason)
