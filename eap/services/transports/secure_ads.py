"""Connections by Secure ADS, and those to other routers (public description, TCP 8016).

Both ends complete TLS, then exchange one message each (``TlsConnectInfo``), then AMS packets follow
without prefix.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from time import monotonic_ns
from typing import ClassVar, NamedTuple

from eap.ams.reassembly import BareAmsDecoder
from eap.ams.spec import SecureRouteSpec
from eap.codec.secureads import (
    AMS_TLS_PORT,
    VERSION,
    ConnectError,
    ConnectFlag,
    ConnectInfo,
    decode_connect_info,
    encode_ansi,
    length_of,
)
from eap.codec.tlshandshake import fingerprint_of
from eap.errors import CodecError, EnvironmentalError
from eap.ids import NetId
from eap.net.reconnecting import connect_tcp
from eap.net.tls import client_context, distrust_of, words_of
from eap.runtime.drop_counters import DropReason
from eap.services.routing.station_router import StationRouter
from eap.services.transports.ams_connection import AmsConnection, PacketHandler
from eap.services.transports.ams_tcp import CONNECT_S, AmsUplink, PeerAddress, UplinkArguments

HANDSHAKE_S = 8.0
"""Time limit of TLS and of the messages behind it."""
SHUTDOWN_S = 1.0
"""Time for the far end to confirm the end of TLS."""


class AmsTlsConnection(AmsConnection):
    """One connection by Secure ADS, which exists before its handshake.

    Attributes:
        transport_name: At the router; empty until the client is known.
    """

    _make_decoder: ClassVar[type[BareAmsDecoder]] = BareAmsDecoder

    def __init__(
        self, name: str, address: str, handler: PacketHandler, *, is_outgoing: bool = False,
        host: str = "",
    ) -> None:  # fmt: skip
        super().__init__(name, address, handler, is_outgoing=is_outgoing, host=host)
        self.transport_name = ""
        self.address = address
        self._task: asyncio.Task[None] | None = None
        self.late_since_ns = monotonic_ns()

    def begin_handshake(self) -> None:
        """Make the running task the one that :meth:`close` cancels until the handshake ends."""
        self._task = asyncio.current_task()

    def take_over(self, transport: asyncio.Transport, received: bytes) -> None:
        """Use *transport* from now on, on which *received* has come already."""
        self._task = None
        self.late_since_ns = None
        transport.set_protocol(self)
        self.connection_made(transport)
        while received and not transport.is_closing():
            buffer = self.get_buffer(len(received))
            size = min(len(buffer), len(received))
            buffer[:size] = received[:size]
            received = received[size:]
            self.buffer_updated(size)
        if not self._is_paused and not transport.is_closing():
            transport.resume_reading()

    def eof_received(self) -> bool:
        """Note the end of the received data; TLS ends in both directions at once (asyncio)."""
        super().eof_received()
        return False

    def _framed(self, packet: bytes) -> bytes:
        """Return a packet as the stream has it: without a prefix."""
        return packet

    def close(self, why: str) -> None:
        """Close it at once, also in its handshake."""
        super().close(why)
        if self._task is not None:
            self._task.cancel()


class MessageReader(asyncio.Protocol):
    """Receiver of the far end's message.

    Attributes:
        message: The message, when it is whole.
        rest: What came behind it.
        lost: Completed when the connection has ended.
    """

    def __init__(self) -> None:
        self.message: asyncio.Future[ConnectInfo] = asyncio.get_running_loop().create_future()
        self.rest = bytearray()
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport (asyncio)."""
        assert isinstance(transport, asyncio.Transport)  # noqa: S101  for the type
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Collect the message (asyncio)."""
        self.rest += data
        if self.message.done():
            return
        try:
            length = length_of(self.rest)
            if length is None or len(self.rest) < length:
                return
            self.message.set_result(decode_connect_info(self.rest))
            del self.rest[:length]
        except CodecError as exc:
            self.message.set_exception(exc)
        self._transport.pause_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the wait for a message (asyncio)."""
        if not self.message.done():
            reason = words_of(exc) if isinstance(exc, OSError) else "closed by the far end"
            self.message.set_exception(ConnectionResetError(reason))
            self.message.exception()  # nobody may wait for it any more
        if not self.lost.done():
            self.lost.set_result(None)

    async def read(self) -> ConnectInfo:
        """Wait for the message.

        Raises:
            CodecError: it is damaged.
            ConnectionError: the connection ended before.
        """
        return await self.message


class SecureOpenError(OSError):
    """A connection to the far end of a route cannot be opened; the text says why.

    Attributes:
        reason: Its counter; None for none.
    """

    def __init__(self, text: str, reason: DropReason | None = None) -> None:
        super().__init__(text)
        self.reason = reason


class OpenedTls(NamedTuple):
    """Opened connection, behind the messages."""

    transport: asyncio.Transport
    rest: bytes
    """Received behind the far end's message."""
    info: ConnectInfo
    """That message."""
    fingerprint: str
    """Of the far end's certificate; empty with a pre-shared key."""


async def open_secure(
    sock: socket.socket, spec: SecureRouteSpec, host: str, info: ConnectInfo
) -> OpenedTls:
    """Complete TLS on a connected socket and exchange the messages.

    Args:
        sock: Connected; closed after a failure.
        spec: Settings of the route, complete.
        host: Name or address in the route.
        info: This end's message.

    Raises:
        SecureOpenError: it failed.
    """
    try:
        async with asyncio.timeout(HANDSHAKE_S):
            transport, reader = await _begin_tls(sock, client_context(spec))
            try:
                return await _exchange(transport, reader, spec, host, info)
            except BaseException:
                transport.abort()
                raise
    except (OSError, CodecError, EnvironmentalError) as exc:
        sock.close()
        raise _failure_of(exc) from None


async def _begin_tls(
    sock: socket.socket, context: ssl.SSLContext
) -> tuple[asyncio.Transport, MessageReader]:
    return await asyncio.get_running_loop().create_connection(
        MessageReader, sock=sock, ssl=context, server_hostname="",
        ssl_handshake_timeout=2 * HANDSHAKE_S, ssl_shutdown_timeout=SHUTDOWN_S,
    )  # fmt: skip


async def _exchange(
    transport: asyncio.Transport, reader: MessageReader, spec: SecureRouteSpec, host: str,
    info: ConnectInfo,
) -> OpenedTls:  # fmt: skip
    """Exchange the messages with a far end that is the right one."""
    connection = transport.get_extra_info("ssl_object")
    if why := distrust_of(spec, host, connection):
        reason = DropReason.TLS_FINGERPRINT if spec.fingerprint else DropReason.TLS_NAME
        raise SecureOpenError(why, reason)
    transport.write(info.encode())
    answer = await reader.read()
    if why := _refusal_in(answer):
        raise SecureOpenError(why)
    shown = connection.getpeercert(binary_form=True)
    print_of_shown = fingerprint_of(shown) if shown else ""
    return OpenedTls(transport, bytes(reader.rest), answer, print_of_shown)


def _refusal_in(answer: ConnectInfo) -> str:
    """Return the reason that the far end refuses this one; empty if it does not."""
    if answer.error != ConnectError.NONE:
        return f"refused: {ConnectError.words_of(answer.error)}"
    if answer.version != VERSION:
        return f"version {answer.version} of Secure ADS, expected {VERSION}"
    return ""


def _failure_of(error: Exception) -> SecureOpenError:
    if isinstance(error, TimeoutError):
        return SecureOpenError(f"no complete handshake within {HANDSHAKE_S:g} s")
    if isinstance(error, ssl.SSLCertVerificationError):
        return SecureOpenError(words_of(error), DropReason.TLS_CERTIFICATE)
    if isinstance(error, SecureOpenError):
        return error
    return SecureOpenError(words_of(error) if isinstance(error, OSError) else str(error))


def hello_of(net_id: NetId, spec: SecureRouteSpec) -> ConnectInfo:
    """Return the message of a router to the far end of a route."""
    is_pinned = spec.psk is None and bool(spec.fingerprint)
    flags = ConnectFlag.SELF_SIGNED if is_pinned else 0
    return ConnectInfo(net_id, flags, socket.gethostname())


async def request_route(
    spec: SecureRouteSpec, address: str, own: tuple[NetId, str], login: tuple[str, str]
) -> None:
    """Request the router at *address* to add a route, and to trust the certificate of this end.

    Args:
        spec: Settings of the connection, complete.
        address: IPv4 address of the other router.
        own: NetID and name of the route, both of this end.
        login: User and password of the other system.

    Raises:
        SecureOpenError: it cannot be reached, is not the right one, or refuses.
    """
    net_id, name = own
    flags = ConnectFlag.ADD_REMOTE | ConnectFlag.IP_ADDRESS | ConnectFlag.IGNORE_NAME
    if spec.fingerprint:
        flags |= ConnectFlag.SELF_SIGNED
    user, password = map(encode_ansi, login)
    info = ConnectInfo(net_id, flags, name, user=user, password=password)
    try:
        sock = await connect_tcp(
            address, AMS_TLS_PORT, None, timeout_s=CONNECT_S, unconfirmed_s=HANDSHAKE_S
        )
    except TimeoutError:
        raise SecureOpenError(f"no answer by TCP {AMS_TLS_PORT}") from None
    except OSError as exc:
        raise SecureOpenError(f"TCP {AMS_TLS_PORT}: {exc.strerror or exc}") from None
    opened = await open_secure(sock, spec, address, info)
    opened.transport.abort()


class AmsTlsUplink(AmsUplink):
    """Connection to one peer by Secure ADS.

    Args:
        peer: Host and port to connect to.
        transport: Its name at the router.
        address: Address of the peer in routes.
        router: Router of the station.
        settings: Of the route, complete.
        rest: As those of :class:`AmsUplink`.
    """

    def __init__(
        self, peer: PeerAddress, transport: str, address: str, router: StationRouter, *,
        settings: SecureRouteSpec, rest: UplinkArguments,
    ) -> None:  # fmt: skip
        super().__init__(peer, transport, address, router, **rest)
        self._net_id = router.net_id
        self._settings = settings

    async def _open(self, sock: socket.socket, host: str) -> AmsConnection:
        """Return the connection on a connected socket, after its handshake."""
        spec = self._settings
        try:
            opened = await open_secure(sock, spec, self.peer.host, hello_of(self._net_id, spec))
        except SecureOpenError as exc:
            if exc.reason is not None:
                self.count_dropped(exc.reason)
            raise
        connection = AmsTlsConnection(str(self.peer), host, self, is_outgoing=True)
        connection.take_over(opened.transport, opened.rest)
        return connection
