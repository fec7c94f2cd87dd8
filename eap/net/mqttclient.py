"""MQTT client: aiomqtt and paho with bounded queues, bounded waits and readable errors.

This is the only module that imports them, and it is imported late.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
from collections.abc import Callable, Iterable
from typing import Any

import aiomqtt
from aiomqtt import Message, MqttError
from aiomqtt.exceptions import MqttConnectError
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from eap.ams.mqtt.network import Publish
from eap.ams.spec import TlsSpec

__all__ = ["MqttClient", "MqttError", "describe", "is_too_new", "make_client", "tls_context"]

MAX_MESSAGE = 1 << 20
"""Maximum size of a message in bytes; the broker is told not to send longer ones."""
MAX_INBOX, MAX_INBOX_OCTETS = 1024, 8 << 20
"""Messages that were received and wait for their turn."""
CONNECT_S, ANSWER_S = 3.0, 5.0
"""Time-outs of a connection attempt, and of a reply of the broker."""
_UNCONFIRMED = 64
_REFUSED = 0x80
"""And above: results of subscriptions that are not granted."""
_UNSUPPORTED = frozenset({1, 0x84})
"""Reasons of brokers that want another version of MQTT (3.1.1 and 5)."""
_LOGIN = frozenset({4, 5, 0x86, 0x87})
"""Reasons of brokers that do not want this user."""

_UNSPECIFIED = 0x80


class Inbox(asyncio.Queue[Message]):
    """Received messages that wait; a message that does not fit is dropped.

    Attributes:
        overrun: Called for each that is.
        octets: Of all that wait.
    """

    overrun: Callable[[], None] | None = None
    octets = 0

    def full(self) -> bool:
        """Return whether the inbox is full, by number or by bytes."""
        return super().full() or self.octets >= MAX_INBOX_OCTETS

    def put_nowait(self, item: Message) -> None:
        """Take *item* if there is room."""
        if not self.full():
            super().put_nowait(item)
        elif self.overrun is not None:
            self.overrun()

    # asyncio.Queue calls these two for each item, also where a getter waits already.
    def _put(self, item: Message) -> None:
        self.octets += len(item.payload)
        super()._put(item)

    def _get(self) -> Message:
        item = super()._get()
        self.octets -= len(item.payload)
        return item


class ClientErrorLog(logging.Handler):
    """Keeps the latest error of paho: often the only source of the reason a connection broke."""

    latest = ""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep it."""
        self.latest = record.getMessage()


class MqttClient(aiomqtt.Client):
    """A client that connects within bounded time and can be closed at any time."""

    error_log: ClientErrorLog

    @property
    def inbox(self) -> Inbox:
        """Received messages that wait."""
        assert isinstance(self._queue, Inbox)  # noqa: S101  made below
        return self._queue

    async def subscribe_all(self, filters: Iterable[str]) -> list[str]:
        """Subscribe with QoS 2; return the filters that the broker rejects."""
        wanted = list(filters)
        codes: Iterable[int | ReasonCode] = await self.subscribe([(each, 2) for each in wanted])
        numbers = (each.value if isinstance(each, ReasonCode) else each for each in codes)
        return [topic for topic, number in zip(wanted, numbers, strict=True) if number >= _REFUSED]

    def publish_soon(self, topic: str, payload: bytes, *, retain: bool) -> None:
        """Queue a message of QoS 0, which leaves with a later one that ``publish`` waits for.

        Raises:
            MqttError: the connection is lost.
        """
        info = self._client.publish(topic, payload, 0, retain)
        if info.rc:
            raise MqttError(f"a message could not be queued: {info.rc.name}")

    def limit_connect(self, timeout_s: float) -> None:
        """Set how long the thread may wait that connects."""
        self._client.connect_timeout = timeout_s

    def _on_socket_register_write(self, client: Any, userdata: Any, sock: Any) -> None:
        """Have the loop write when *sock* takes more; called by paho, also in a thread."""

        # aiomqtt passes the loop the number of a socket that may be closed by the time the loop
        # comes to it, and then an error, or another socket has the number.
        def register() -> None:
            if sock.fileno() >= 0:
                self._loop.add_writer(sock.fileno(), write)

        def write() -> None:
            try:
                client.loop_write()
            except Exception as exc:  # noqa: BLE001  as aiomqtt does: the connection is lost
                if not self._disconnected.done():
                    self._disconnected.set_exception(exc)

        self._loop.call_soon_threadsafe(register)

    def close(self) -> None:
        """Close the connection, also one that was abandoned during its set-up."""
        self._client.disconnect()


class _Socket(ssl.SSLSocket):
    """A socket that does not wait for long for the other end of TLS, and is closed if that fails.

    Left to itself paho waits as long as the broker may be silent, and leaves the socket open.
    """

    def do_handshake(self, block: bool = False) -> None:
        """Agree with the other end."""
        self.settimeout(CONNECT_S)
        try:
            super().do_handshake(block)
        except OSError:
            self.close()
            raise


def tls_context(spec: TlsSpec | None) -> ssl.SSLContext | None:
    """Return the TLS context of a connection, None for one without encryption.

    Raises:
        OSError: a file is missing or invalid.
    """
    if spec is None:
        return None
    context = ssl.create_default_context(cafile=spec.ca or None)
    # From Python 3.13 on, certificates without the extensions of RFC 5280 would be refused: those
    # of many brokers in plants have none.
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT
    context.sslsocket_class = _Socket
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.check_hostname = spec.check_name
    if spec.certificate:
        context.load_cert_chain(spec.certificate, spec.key or None)
    return context


def make_client(
    host: str, port: int, client_id: str, *,
    login: tuple[str, str] | None, tls: ssl.SSLContext | None, will: Publish, keepalive_s: int,
    is_old: bool,
) -> MqttClient:  # fmt: skip
    """Return a client that is not connected yet; *is_old* makes it speak MQTT 3.1.1."""
    properties = None
    if not is_old:
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        # paho reads a packet as a whole before it is seen here; only the broker can prevent that.
        properties.MaximumPacketSize = MAX_MESSAGE
        properties.ReceiveMaximum = _UNCONFIRMED
    user, password = login or (None, None)
    # Of this client alone, without other handlers.
    logger = logging.Logger(__name__, logging.ERROR)  # noqa: LOG001
    error_log = ClientErrorLog()
    logger.addHandler(error_log)
    client = MqttClient(
        host,
        port,
        username=user,
        password=password,
        identifier=client_id,
        logger=logger,
        queue_type=Inbox,
        max_queued_incoming_messages=MAX_INBOX,
        protocol=aiomqtt.ProtocolVersion.V311 if is_old else aiomqtt.ProtocolVersion.V5,
        properties=properties,
        will=aiomqtt.Will(will.topic, will.payload, will.qos, will.is_retained),
        tls_context=tls,
        timeout=ANSWER_S,
        keepalive=keepalive_s,
    )
    client.error_log = error_log
    client.limit_connect(CONNECT_S)
    return client


def is_too_new(error: MqttError) -> bool:
    """Return whether the broker may speak another version; some of them just say nothing."""
    if isinstance(error, MqttConnectError):
        return _code(error) in _UNSUPPORTED
    return str(error) == "Operation timed out"  # connected, but not answered


def describe(error: MqttError, client: MqttClient, user: str) -> str:
    """Return the reason that there is no connection, as text."""
    if isinstance(error, MqttConnectError) and _code(error) in _LOGIN:
        if not user:
            return "a login is required: set 'user' and 'password_file', or 'tls'"
        return f"user {user!r} or the password is rejected: check 'user' and 'password_file'"
    cause = error.__cause__ or error
    if _code(cause) == _UNSPECIFIED:
        return client.error_log.latest or "the connection broke"
    return client.error_log.latest or str(cause) or type(error).__name__


def _code(error: BaseException) -> int | None:
    reason = getattr(error, "rc", None)
    return reason.value if isinstance(reason, ReasonCode) else reason
