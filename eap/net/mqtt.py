"""Connection to an MQTT broker, made again whenever it is lost (MQTT 5, else 3.1.1).

aiomqtt is an extra of this project and imported only where a plant has a broker.  MQTT 5 comes
first because only there a client can limit the length of messages; with an older broker, only the
limit of the broker itself applies.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from eap.ams.mqtt.network import Publish, Subscribe
from eap.ams.spec import MqttSpec
from eap.errors import EnvironmentalError
from eap.net.host import read_password_text
from eap.net.reconnecting import ReconnectingLink, ReconnectPolicy

if TYPE_CHECKING:
    from eap.net.mqttclient import MqttClient

KEEPALIVE_S = 10
"""Silence after which the client pings the broker; the broker waits half as long again."""
MAX_WAITING = 1024
"""Messages that wait to be sent."""
MAX_WAITING_OCTETS = 8 << 20
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 15.0
"""Between two attempts to connect: the longest that the first wait may be, and the limit."""
_STABLE_S = 10.0
"""Duration from which a connection counts as stable."""
_DISCONNECT_S = 0.3
_PROBE_S = 3.0
_UNCONFIRMED = 16
"""Messages of QoS 1 and 2 on their way at a time."""
_TOGETHER = 256
"""Messages of QoS 0 that are sent together."""

Outgoing: TypeAlias = Publish | Subscribe

logger = logging.getLogger(__name__)


class Handlers(NamedTuple):
    """Callbacks of a link; all of them return at once."""

    connected: Callable[[], None]
    """Messages can be sent."""
    lost: Callable[[str], None]
    """The connection is lost; the argument is the reason as text."""
    message: Callable[[str, bytes, bool], None]
    """Topic, payload, and whether the broker had kept it."""
    overrun: Callable[[], None]
    """A message was dropped because the inbox is full."""
    drained: Callable[[], None] = lambda: None
    """All messages have been sent."""


class MqttLink(ReconnectingLink):
    """One broker.

    Args:
        spec: Its address, and the login of this client.
        client_id: At the broker.
        will: Returns what the broker publishes when this end is lost, and this end when it closes;
            called for each connection.
        handlers: Callbacks.

    Raises:
        EnvironmentalError: aiomqtt is not installed.
    """

    def __init__(
        self, spec: MqttSpec, client_id: str, *, will: Callable[[], Publish], handlers: Handlers
    ) -> None:
        require_mqtt()
        super().__init__(ReconnectPolicy(FIRST_PAUSE_S, LONGEST_PAUSE_S, _STABLE_S))
        self._spec = spec
        self._client_id = client_id
        self._make_will = will
        self._handlers = handlers
        self._name = f"MQTT broker {spec.host}:{spec.port}"
        self._outbox: asyncio.Queue[Outgoing] = asyncio.Queue()
        self._octets = 0
        self._is_connected = False
        self._is_old = False
        self._is_silent = False
        self._connections = self._connections_before = 0

    @property
    def waiting(self) -> int:
        """Number of messages that wait to be sent."""
        return self._outbox.qsize()

    def send(self, message: Outgoing) -> str | None:
        """Queue *message*; return the reason if it cannot be sent, else None."""
        if not self._is_connected:
            return f"no connection to {self._name}: {self.reason or 'not yet'}"
        if self._outbox.qsize() >= MAX_WAITING or self._octets > MAX_WAITING_OCTETS:
            return f"too much waits for {self._name}"
        self._octets += _size(message)
        self._outbox.put_nowait(message)
        return None

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Log another reason (ReconnectingLink)."""
        if has_lasted:
            self._connections = 0
        # A broker disconnects the client that has a name already when another connects with it, so
        # two of them throw each other out in turn.
        elif self._connections > max(self._connections_before, 1):
            reason += f"; has another client the name {self._client_id!r} (client_id) too?"
        if self._is_new_reason(reason):  # a broker that is away for long is no flood of lines
            logger.warning("%s: %s; trying again", self._name, reason)
        return True

    async def _connect(self) -> str:
        """Connect and serve until the connection is lost (ReconnectingLink)."""
        from eap.net.mqttclient import MqttError, describe, is_too_new, make_client, tls_context

        self._connections_before = self._connections
        try:
            if self._is_silent:
                await self._probe()
            will = self._make_will()
            client = make_client(
                self._spec.host, self._spec.port, self._client_id,
                login=self._login(), tls=tls_context(self._spec.tls), will=will,
                keepalive_s=KEEPALIVE_S, is_old=self._is_old,
            )  # fmt: skip
        except (OSError, UnicodeError, EnvironmentalError) as exc:  # what files hold
            return str(exc) or "timed out"
        try:
            async with client:
                await self._serve(client, will)
            why = "it was closed"
        except MqttError as exc:
            # Tried by turns, since the reason is not certain: some brokers just say nothing.
            if not self._is_connected and is_too_new(exc):
                self._is_old = not self._is_old
            why = describe(exc, client, self._spec.user)
            self._is_silent = "timed out" in why
        finally:
            client.close()
        if self._is_connected:
            self._is_connected = self._is_old = False  # by next time it may be a newer one
            self._handlers.lost(f"no connection to {self._name}: {why}")
        return why

    async def _probe(self) -> None:
        """Raise OSError if nothing listens at the broker's address.

        This can be cancelled.  paho connects in a thread, which cannot, and which would delay the
        end of the process.
        """
        async with asyncio.timeout(_PROBE_S):
            _, writer = await asyncio.open_connection(self._spec.host, self._spec.port)
        writer.close()
        await writer.wait_closed()

    async def _serve(self, client: MqttClient, will: Publish) -> None:
        self._outbox = asyncio.Queue()
        self._octets = 0
        self._is_connected = True
        self._connections += 1  # without a good one in between
        logger.info("%s: connected as %s", self._name, self._client_id)
        self.reason = ""
        if self._is_old:
            logger.warning("%s speaks no MQTT 5: the longest message is its own affair", self._name)
        self._handlers.connected()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._write(client, group))
                await self._read(client)
        except asyncio.CancelledError:
            with suppress(Exception):  # the broker gets to know in any case
                async with asyncio.timeout(_DISCONNECT_S):
                    await _publish(client, will)
            raise
        except ExceptionGroup as group_error:
            first = group_error.exceptions[0]
            raise first from first.__cause__

    async def _read(self, client: MqttClient) -> None:
        client.inbox.overrun = self._handlers.overrun
        async for message in client.messages:
            self._handlers.message(message.topic.value, message.payload, message.retain)

    async def _write(self, client: MqttClient, group: asyncio.TaskGroup) -> None:
        # QoS 1 and 2 wait for the broker; one after the other would take a round trip each.
        room = asyncio.Semaphore(_UNCONFIRMED)

        async def confirm(message: Publish) -> None:
            try:
                await _publish(client, message)
            finally:
                room.release()

        together = 0
        own = asyncio.current_task()
        # asyncio.wait_for of Python 3.11 forgets a cancellation that comes together with the answer
        # of the broker: this task would wait for ever, or start another one in a group that ends.
        while own is not None and not own.cancelling():
            message = await self._outbox.get()
            self._octets -= _size(message)
            is_last = self._outbox.empty() or together >= _TOGETHER
            if isinstance(message, Publish) and not message.qos and not is_last:
                # To wait for each would cost more than all else: five times the time for each.
                client.publish_soon(message.topic, message.payload, retain=message.is_retained)
                together += 1
                continue
            together = 0
            if isinstance(message, Subscribe):
                await self._subscribe(client, message)
            elif message.qos:
                await room.acquire()
                group.create_task(confirm(message))
            else:
                await _publish(client, message)
            if self._outbox.empty():
                self._handlers.drained()

    async def _subscribe(self, client: MqttClient, message: Subscribe) -> None:
        for topic in await client.subscribe_all(message.filters):
            logger.warning("%s does not let %s read %s", self._name, self._client_id, topic)

    def _login(self) -> tuple[str, str] | None:
        spec = self._spec
        if not spec.user:
            return None
        file = spec.password_file
        return spec.user, read_password_text(Path(file)) if file else ""


def require_mqtt() -> None:
    """Raise EnvironmentalError, and say what to do, if this installation has no MQTT."""
    try:
        import aiomqtt  # noqa: F401  only whether it is there
    except ImportError:
        raise EnvironmentalError(
            "MQTT needs aiomqtt, which is not installed: pip install 'eap-appliance[mqtt]'"
            " (in the project's folder: pip install '.[mqtt]')"
        ) from None


async def _publish(client: MqttClient, message: Publish) -> None:
    await client.publish(
        message.topic, message.payload, qos=message.qos, retain=message.is_retained
    )


def _size(message: Outgoing) -> int:
    return len(message.payload) if isinstance(message, Publish) else 0
