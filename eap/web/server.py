"""The page's server: static files, API, WebSockets, and the policy of its connections."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

from aiohttp import web

from eap.config.listen import parse_listen
from eap.config.web_sections import ServerSection, WebSection
from eap.errors import EnvironmentalError
from eap.live.view import LiveReport, LiveView
from eap.web.api import API, Api
from eap.web.feed import PlantFeed
from eap.web.guard import MAX_BODY, Guard
from eap.web.metrics import PATH as METRICS
from eap.web.metrics import MetricsEndpoint
from eap.web.sessions import Sessions
from eap.web.sockets import WebSocketServer
from eap.web.topics import PageTopics

STATIC = Path(__file__).parent / "static"
MAX_CONNECTIONS = 512
MAX_PER_HOST = 256
HANDSHAKE_S = 10.0
"""Time for the TLS handshake of a connection."""
SHUTDOWN_S = 2.0
"""Time for the end of TLS of a connection."""
SLOW_READER_S = 20.0
_KEEPALIVE_S = 20.0
_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".txt": "text/plain",
    ".woff2": "font/woff2",
    ".webmanifest": "application/manifest+json",
}

logger = logging.getLogger(__name__)


class PageServer:
    """Page and API of one plant.

    Args:
        section: The key ``web``.
        view: The appliances.
        key: Secret for sessions, 32 bytes.
    """

    def __init__(self, section: WebSection, view: LiveView, key: bytes) -> None:
        self._section = section
        self._view = view
        users = {user.name: user for user in section.users}
        self.guard = Guard(section, Sessions(key, users))
        self.feed = PlantFeed(view, on_status=self._status_changed)
        self.topics = PageTopics(self.feed)
        self.sockets = WebSocketServer(self.feed, self.topics, self.guard)
        self.api = Api(section, self.feed, self.topics, self.guard, self.sockets.end_session)

    def application(self) -> web.Application:
        """Return the application, whose tasks run as long as it does."""
        app = web.Application(middlewares=[self.guard.check], client_max_size=MAX_BODY)
        app.router.add_get(f"{API}/ws", self.sockets.serve)
        app.router.add_routes(self.api.routes())
        app.router.add_get(METRICS, MetricsEndpoint(self._latest_report).answer)
        app.router.add_get("/", partial(_static, "index.html"))
        for name in sorted(each.name for each in STATIC.iterdir() if each.suffix in _TYPES):
            app.router.add_get(f"/{name}", partial(_static, name))
        app.cleanup_ctx.append(self._run)
        return app

    async def _latest_report(self) -> LiveReport | None:
        return self.feed.report

    def _status_changed(self) -> None:
        self.api.update_pages()
        self.topics.status_changed()

    async def _run(self, app: web.Application) -> AsyncIterator[None]:
        """Follow the plant while the application runs."""
        del app
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(self.feed.run()), group.create_task(self.topics.run())]
            tasks.append(group.create_task(self.guard.report_logins(self._view)))
            yield
            await self.sockets.close_all()
            for task in tasks:
                task.cancel()


async def _static(name: str, request: web.Request) -> web.Response:
    """Return a file of the page; the routes name all of them, so no path is made of a request."""
    path = STATIC / name
    stat = path.stat()
    tag = f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'
    # After an update of the package a browser must not mix old files with new ones.
    headers = {"ETag": tag, "Cache-Control": "no-cache"}
    if request.headers.get("If-None-Match") == tag:
        return web.Response(status=304, headers=headers)
    kind = _TYPES[path.suffix]
    body = await asyncio.to_thread(path.read_bytes)
    charset = "utf-8" if kind.startswith("text/") else None
    return web.Response(body=body, content_type=kind, charset=charset, headers=headers)


def open_listener(section: ServerSection) -> socket.socket:
    """Return the listening socket of the key ``web`` or ``metrics``.

    Raises:
        EnvironmentalError: it cannot be opened.
    """
    listen = parse_listen(section.listen)
    family = socket.AF_INET6 if ":" in listen.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(tuple(listen))
        listener.listen(128)
    except OSError as exc:
        listener.close()
        reason = f"{section.KEY}: cannot listen on {section.listen}: {exc.strerror}"
        advice = f"free it, or change listen of the key {section.KEY}"
        raise EnvironmentalError(f"{reason}; {advice}") from None
    listener.setblocking(False)
    return listener


def tls_context(section: ServerSection) -> ssl.SSLContext | None:
    """Return the TLS settings, None without TLS.

    Raises:
        EnvironmentalError: certificate or key cannot be used.
    """
    if section.tls is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    # RFC 8996: the versions before must not be used.
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # With a password given, even an empty one, OpenSSL asks for none at a terminal.
        context.load_cert_chain(section.tls.certificate, section.tls.key, password=lambda: b"")
    except (OSError, ssl.SSLError) as exc:
        reason = exc.strerror or exc
        raise EnvironmentalError(
            f"{section.KEY}: tls: {section.tls.certificate}: {reason}"
        ) from None
    return context


@asynccontextmanager
async def serving(
    application: web.Application, listener: socket.socket, context: ssl.SSLContext | None
) -> AsyncIterator[None]:
    """Serve connections of *listener* for the length of a block."""
    runner = web.AppRunner(
        application,
        access_log=None,
        handle_signals=False,
        keepalive_timeout=_KEEPALIVE_S,
        shutdown_timeout=0.5,
    )
    await runner.setup()
    assert runner.server is not None  # noqa: S101  setup has made it
    connections = Connections(runner.server, listener, context)
    try:
        async with asyncio.TaskGroup() as group:
            accepting = group.create_task(connections.accept(group))
            yield
            accepting.cancel()
    finally:
        await runner.cleanup()


class Connections:
    """Open connections: so many in all and of a host.

    aiohttp closes a connection without a request after _KEEPALIVE_S, the kernel one that does not
    take an answer for SLOW_READER_S.

    Args:
        server: Handles the requests.
        listener: Its connections are accepted.
        context: TLS settings.
    """

    def __init__(
        self, server: web.Server, listener: socket.socket, context: ssl.SSLContext | None
    ) -> None:
        self._server = server
        self._listener = listener
        self._context = context
        self._hosts: dict[web.RequestHandler, str] = {}
        """Connections, with their host; closed ones until the next is accepted."""
        self._beginning: set[web.RequestHandler] = set()
        """Those in their TLS handshake."""

    async def accept(self, group: asyncio.TaskGroup) -> None:
        """Accept connections until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                sock, address = await loop.sock_accept(self._listener)
            except OSError as exc:  # out of descriptors: those that close free some
                logger.warning("no connection can be accepted: %s", exc.strerror)
                await asyncio.sleep(1.0)
                continue
            host = str(address[0])
            if self._is_full(host):
                sock.close()
                continue
            group.create_task(self._begin(sock, host))

    def _is_full(self, host: str) -> bool:
        known = self._beginning.union(self._server.connections)
        # aiohttp tells which connections are open, not when one has ended.
        self._hosts = {each: own for each, own in self._hosts.items() if each in known}
        hosts = Counter(self._hosts.values())
        return hosts.total() >= MAX_CONNECTIONS or hosts[host] >= MAX_PER_HOST

    async def _begin(self, sock: socket.socket, host: str) -> None:
        handler = self._server()
        self._hosts[handler] = host
        self._beginning.add(handler)
        timeouts = {}
        if self._context is not None:
            # A client that does not answer the end of TLS holds its place no longer than that.
            timeouts = {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": SHUTDOWN_S}
        try:
            # The kernel ends the connection of a client that acknowledges nothing.
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(SLOW_READER_S * 1000))
            await asyncio.get_running_loop().connect_accepted_socket(
                lambda: handler, sock, ssl=self._context, **timeouts
            )
        except OSError as exc:  # ssl.SSLError, too: no TLS, or none that is known here
            logger.debug("connection from %s: %s", host, exc)
            sock.close()
        finally:
            self._beginning.discard(handler)
