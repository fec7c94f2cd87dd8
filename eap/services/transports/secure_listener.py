"""Listeners for Secure ADS: clients are known by certificates or keys before they send packets.

Rule 1: a client is known by its pre-shared key, the fingerprint of its certificate, or an authority
that signed it.  Its name is part of the name of its transport (``ams-tls:panel-1``), which access
rules, audit and status use as they use any other.
Rule 2: a client with an unknown self-signed certificate gets its answer and nothing else, unless
it requests a route with the password of a user of the station.
Rule 3: a handshake has one limit for its whole duration, and new connections have rates: each of
them costs the calculation of keys.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from time import monotonic
from typing import NamedTuple

from eap.ams.spec import SecureAdsSpec, TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.amsdiscovery import Discovery, DiscoveryHeader, DiscoveryService, Tag, encode_text
from eap.codec.secureads import (
    VERSION,
    ConnectError,
    ConnectFlag,
    ConnectInfo,
    decode_ansi,
)
from eap.errors import CodecError, EnvironmentalError
from eap.net.ipsocket import open_tcp_listener
from eap.net.limits import (
    OWN_HOST,
    CloseReason,
    Rate,
    SourceRateLimiter,
    SourceRates,
)
from eap.net.tcp import set_stream_options
from eap.net.tls import TlsPeer, server_context, words_of
from eap.runtime.drop_counters import DropReason
from eap.services.limited_log import caused_by
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.tasks import keep_serving
from eap.services.transports.accepting import (
    Listeners,
    connection_name,
    wait_readable,
)
from eap.services.transports.ams_connection import AmsConnection
from eap.services.transports.ams_discovery import RouteAdmin
from eap.services.transports.ams_tcp import AmsClients, AmsListener
from eap.services.transports.route_logins import RouteLogins
from eap.services.transports.secure_ads import (
    HANDSHAKE_S,
    SHUTDOWN_S,
    AmsTlsConnection,
    MessageReader,
)

RATES = SourceRates(
    source=Rate(32, 4.0),
    known=Rate(128, 16.0),
    new=Rate(64, 16.0),
    local=Rate(256, 64.0),
)
"""Rates of new connections: a handshake takes 2.4 ms of this process."""
MAX_SOURCES = 1024
MAX_NAME = 64
RETRY_S = 5.0
"""Pause before the next attempt to open a listener."""
TLS_PREFIX = f"{TransportKind.AMS_TLS}:"
"""Prefix of the names of transports; a client's name or the address of a peer follows."""

logger = logging.getLogger(__name__)


class _RefusedError(Exception):
    """A client may not send packets.

    Attributes:
        error: For its response.
        reason: Its counter.
    """

    def __init__(self, error: ConnectError, reason: DropReason, text: str) -> None:
        super().__init__(text)
        self.error = error
        self.reason = reason


class ServerSettings(NamedTuple):
    """Settings of one listener.

    Attributes:
        spec: Secure ADS of the station.
        known: Returns the names of trusted clients by their fingerprints.
        route_admin: Handles requests for routes.
    """

    spec: SecureAdsSpec
    known: Callable[[], Mapping[str, str]]
    route_admin: RouteAdmin


class AmsTlsListener(AmsListener[AmsTlsConnection]):
    """One listening socket of a station.

    Args:
        listener: The socket; closed by :meth:`close`.
        router: Of the station.
        settings: Its keys, and its trusted clients.
        count_dropped: Counts dropped packets and connections.
        listeners: All listeners of the process.
    """

    def __init__(
        self,
        listener: socket.socket,
        router: StationRouter,
        settings: ServerSettings,
        count_dropped: Callable[[DropReason], object],
        listeners: Listeners,
    ) -> None:
        self._router = router
        self._settings = settings
        self._clients = AmsClients()
        self._of_transport: dict[str, set[str]] = {}
        self._limiter = SourceRateLimiter(RATES, MAX_SOURCES, monotonic())
        name = f"{TransportKind.AMS_TLS} {{}}:{{}}".format(*listener.getsockname())
        super().__init__(listener, name, DropReason.TLS_FULL, count_dropped, listeners)

    def connection_from(self, sock: socket.socket, host: str) -> AmsTlsConnection:
        """Return the connection on an accepted socket (ConnectionServer)."""
        set_stream_options(sock)
        address, now_s = sock.getpeername()[0], monotonic()
        limiter = self._limiter
        is_local = host == OWN_HOST
        if not (limiter.take_local(now_s) if is_local else limiter.take(address, now_s)):
            self.count_dropped(DropReason.TLS_FULL)
            raise ConnectionRefusedError(f"{address} connects too often")
        return AmsTlsConnection(connection_name(sock), address, self, host=host)

    async def serve_connection(self, connection: AmsTlsConnection, sock: socket.socket) -> None:
        """Serve a connection until its end (ConnectionServer)."""
        connection.begin_handshake()
        try:
            async with asyncio.timeout(HANDSHAKE_S):
                if not await self._shake_hands(connection, sock):
                    return
        except TimeoutError:
            text = f"no complete handshake within {HANDSHAKE_S:g} s"
            self._refuse(connection, DropReason.TLS_SLOW, text)
            return
        try:
            await connection.closed
        finally:
            connection.close(CloseReason.ENDED)

    def connection_opened(self, connection: AmsConnection) -> None:
        """Add the connection (PacketHandler)."""
        name = _transport_of(connection)
        if not self._of_transport.setdefault(name, set()):
            transport = Transport(name, is_stream=True, is_hub=True)
            self._router.add_transport(transport, self._clients)
        self._of_transport[name].add(connection.name)
        self._clients.add(connection)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Remove the connection, and with the last of a client its transport (PacketHandler)."""
        logger.debug("Secure ADS connection %s: %s", connection.name, why)
        name = _transport_of(connection)
        self._clients.remove(connection)
        self._router.connection_closed(name, connection.name)
        self._of_transport[name].remove(connection.name)
        if not self._of_transport[name]:
            del self._of_transport[name]
            self._router.remove_transport(name)

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Forward a request to the station (PacketHandler)."""
        self._router.receive(packet, _transport_of(connection), connection.name)

    async def _shake_hands(self, connection: AmsTlsConnection, sock: socket.socket) -> bool:
        """Complete TLS and exchange the messages; return whether packets may follow."""
        loop = asyncio.get_running_loop()
        # Nothing is calculated for a client that sends nothing.
        await wait_readable(sock)
        try:
            # A context for each: that of one client trusts its certificate.
            context = server_context(self._settings.spec)
            transport, reader = await loop.connect_accepted_socket(
                MessageReader, sock, ssl=context, ssl_handshake_timeout=2 * HANDSHAKE_S,
                ssl_shutdown_timeout=SHUTDOWN_S,
            )  # fmt: skip
        except EnvironmentalError as exc:
            self._refuse(connection, DropReason.TLS_HANDSHAKE, str(exc))
            return False
        except OSError as exc:
            self._refuse(connection, _counter_of(exc), words_of(exc))
            return False
        try:
            info = await reader.read()
            peer = context.peer_of(transport.get_extra_info("ssl_object"))
            name = await self._admit(connection, info, peer)
            transport.write(self._response(ConnectError.NONE))
            connection.transport_name = f"{TLS_PREFIX}{name}"
            connection.take_over(transport, bytes(reader.rest))
        except _RefusedError as exc:
            self._refuse(connection, exc.reason, str(exc))
            transport.write(self._response(exc.error))
        except CodecError as exc:
            self._refuse(connection, DropReason.TLS_INFO, str(exc))
        except ConnectionError as exc:
            self._refuse(connection, DropReason.TLS_INFO, words_of(exc))
        finally:
            if not connection.transport_name:
                transport.close()
                # The caller closes the socket next, which has to leave the loop before.
                await asyncio.wait([reader.lost], timeout=2 * SHUTDOWN_S)
                transport.abort()
        return bool(connection.transport_name)

    async def _admit(self, connection: AmsTlsConnection, info: ConnectInfo, peer: TlsPeer) -> str:
        """Return the name of a client; raise _RefusedError if it may not send packets."""
        if info.version != VERSION:
            text = f"version {info.version} of Secure ADS, expected {VERSION}"
            raise _RefusedError(ConnectError.VERSION, DropReason.TLS_VERSION, text)
        if info.flags & ConnectFlag.ADD_REMOTE and peer.fingerprint:
            return await self._add_route(connection, info, peer)
        known = self._settings.known()
        if (name := known.get(peer.fingerprint)) is not None:
            return name
        if not peer.is_trusted:
            text = f"unknown certificate of {peer.name or 'nobody'}: {peer.fingerprint}"
            raise _RefusedError(ConnectError.CERTIFICATE, DropReason.TLS_FINGERPRINT, text)
        text = ""
        if not peer.name or len(peer.name) > MAX_NAME or not peer.name.isprintable():
            text = f"common name {peer.name[:MAX_NAME]!r}: expected up to {MAX_NAME} characters"
        elif ":" in peer.name:
            # It would be the name of a route's transport.
            text = f"common name {peer.name!r}: expected one without colons"
        elif peer.name in known.values():
            text = f"common name {peer.name!r}: it is the name of a client with a fingerprint"
        if text:
            raise _RefusedError(ConnectError.NAME, DropReason.TLS_NAME, text)
        return peer.name

    async def _add_route(
        self, connection: AmsTlsConnection, info: ConnectInfo, peer: TlsPeer
    ) -> str:
        """Add the route that a client requests, as by UDP 48899, and trust its fingerprint."""
        result = await self._settings.route_admin.handle(
            _as_discovery(info, connection.address),
            connection.address,
            is_this_host=connection.host == OWN_HOST,
            fingerprint=peer.fingerprint,
        )
        name = self._settings.known().get(peer.fingerprint)
        if result != AdsError.NONE:
            text = f"route for {info.net_id} refused"
            raise _RefusedError(ConnectError.USER, DropReason.TLS_USER, text)
        if name is None:
            text = f"a route of the plant file leads to {info.net_id}: write its fingerprint there"
            raise _RefusedError(ConnectError.CERTIFICATE, DropReason.TLS_FINGERPRINT, text)
        return name

    def _response(self, error: ConnectError) -> bytes:
        flags = ConnectFlag.RESPONSE
        if error == ConnectError.NONE:
            flags |= ConnectFlag.AMS_ALLOWED
        return ConnectInfo(self._router.net_id, flags, socket.gethostname(), error).encode()

    def _refuse(self, connection: AmsTlsConnection, reason: DropReason, text: str) -> None:
        self.count_dropped(reason)
        cause = caused_by((self.name, reason, connection.address), connection.address)
        logger.warning(
            "%s: %s refused (%s): %s", self.name, connection.address, reason, text, extra=cause
        )


def _transport_of(connection: AmsConnection) -> str:
    assert isinstance(connection, AmsTlsConnection)  # noqa: S101  for the type
    return connection.transport_name


def _counter_of(error: OSError) -> DropReason:
    """Return the counter of a failed handshake."""
    is_certificate = isinstance(error, ssl.SSLCertVerificationError) or (
        isinstance(error, ssl.SSLError) and error.reason == "PEER_DID_NOT_RETURN_A_CERTIFICATE"
    )
    return DropReason.TLS_CERTIFICATE if is_certificate else DropReason.TLS_HANDSHAKE


def _as_discovery(info: ConnectInfo, address: str) -> Discovery:
    """Return the request for a route as one by UDP 48899."""
    is_named = info.host and not info.flags & ConnectFlag.IP_ADDRESS
    host = info.host if is_named else address
    header = DiscoveryHeader(0, 0, DiscoveryService.ADD_ROUTE, info.net_id, 0)
    tags = (
        (Tag.NET_ID, bytes(info.net_id)),
        (Tag.ROUTE_NAME, encode_text(info.host or address)),
        (Tag.HOST, encode_text(host)),
        # UDP 48899 has texts in UTF-8.
        (Tag.USER, encode_text(decode_ansi(info.user).partition("\0")[0])),
        (Tag.PASSWORD, encode_text(decode_ansi(info.password).partition("\0")[0])),
    )
    return Discovery(header, tags)


class SecureListeners:
    """Listeners of one station for Secure ADS, which follow its configuration and addresses.

    Args:
        routes: Of the station.
        addresses: Where the station serves AMS; the caller changes them, then calls
            :meth:`follow`.
        count_dropped: Counts dropped packets and connections.
        listeners: All listeners of the process.
        logins: Of requests for routes.
    """

    def __init__(
        self,
        routes: StationRoutes,
        addresses: Collection[str],
        count_dropped: Callable[[DropReason], object],
        listeners: Listeners,
        logins: RouteLogins,
    ) -> None:
        self._routes = routes
        self._addresses = addresses
        self._count_dropped = count_dropped
        self._listeners = listeners
        self._route_admin = RouteAdmin([routes], logins)
        self._open: dict[_ListenerKey, AmsTlsListener] = {}
        self._tasks: dict[_ListenerKey, asyncio.Task[None]] = {}
        self._changed = asyncio.Event()

    async def serve(self) -> None:
        """Keep the listeners open until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                while True:
                    self._changed.clear()
                    is_complete = await self._follow(group)
                    # An address that is taken, or not there yet, may be free later.
                    with suppress(TimeoutError):
                        async with asyncio.timeout(None if is_complete else RETRY_S):
                            await self._changed.wait()
        finally:
            for listener in self._open.values():
                listener.close()
            self._open.clear()
            self._tasks.clear()

    def follow(self) -> None:
        """Open and close listeners after configuration or addresses have changed."""
        self._changed.set()

    async def _follow(self, group: asyncio.TaskGroup) -> bool:
        """Return whether all wanted listeners are open."""
        spec = self._routes.spec.secure
        wanted = set()
        if spec is not None and spec.port:
            wanted = {_ListenerKey(each, spec) for each in self._addresses}
        leaving = self._open.keys() - wanted
        tasks = [self._tasks.pop(key) for key in leaving]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for key in leaving:
            self._open.pop(key).close()
        for key in wanted - self._open.keys():
            self._try_to_open(key, group)
        return wanted <= self._open.keys()

    def _try_to_open(self, key: _ListenerKey, group: asyncio.TaskGroup) -> None:
        router = self._routes.router
        try:
            server_context(key.spec)  # its files, before a client meets them
            sock = open_tcp_listener(key.address, key.spec.port)
        except EnvironmentalError as exc:
            cause = caused_by((router.name, key.address, str(exc)), router.name)
            logger.warning("%s: no Secure ADS at %s: %s", router.name, key.address, exc,
                           extra=cause)  # fmt: skip
            return
        settings = ServerSettings(key.spec, self._routes.secure_clients, self._route_admin)
        listener = AmsTlsListener(sock, router, settings, self._count_dropped, self._listeners)
        self._open[key] = listener
        self._tasks[key] = group.create_task(keep_serving(listener.serve))


class _ListenerKey(NamedTuple):
    """All that a listener depends on; with other settings it is another one."""

    address: str
    spec: SecureAdsSpec
