"""Metrics by HTTP: a path of the page, or a server of their own."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from time import monotonic

from aiohttp import web

from eap.config.web_sections import MetricsSection
from eap.live.metrics import CONTENT_TYPE, MetricsWriter
from eap.live.view import LiveReport, LiveView
from eap.web.guard import MAX_BODY, Guard, needs_user
from eap.web.sessions import KEY_BYTES, Sessions

PATH = "/metrics"
_AGE_S = 1.0
"""Collectors that ask more often get the same numbers: each report costs services a request."""


class MetricsEndpoint:
    """Handler of ``GET /metrics``.

    Args:
        report: Returns the present report; None while there is none.
    """

    def __init__(self, report: Callable[[], Awaitable[LiveReport | None]]) -> None:
        self._report = report
        self._writer = MetricsWriter()

    async def answer(self, request: web.Request) -> web.Response:
        """Answer a collector."""
        needs_user(request)
        report = await self._report()
        if report is None:
            raise web.HTTPServiceUnavailable(reason="the plant has not answered yet")
        body = self._writer.write(report.status, len(report.unreachable)).encode()
        return web.Response(body=body, headers={"Content-Type": CONTENT_TYPE})


class MetricsServer:
    """Server of metrics alone.

    Args:
        section: The key ``metrics``.
        view: The appliances.
    """

    def __init__(self, section: MetricsSection, view: LiveView) -> None:
        # Nobody logs in here, so no session outlives this process.
        self._guard = Guard(section, Sessions(secrets.token_bytes(KEY_BYTES), {}))
        self._view = view
        self._lock = asyncio.Lock()
        self._latest: LiveReport | None = None
        self._taken_s = 0.0

    def application(self) -> web.Application:
        """Return the application."""
        app = web.Application(middlewares=[self._guard.check], client_max_size=MAX_BODY)
        app.router.add_get(PATH, MetricsEndpoint(self._take).answer)
        app.cleanup_ctx.append(self._run)
        return app

    async def _run(self, app: web.Application) -> AsyncIterator[None]:
        """Report refused logins while the application runs."""
        del app
        async with asyncio.TaskGroup() as group:
            task = group.create_task(self._guard.report_logins(self._view))
            yield
            task.cancel()

    async def _take(self) -> LiveReport | None:
        async with self._lock:
            if self._latest is None or monotonic() - self._taken_s >= _AGE_S:
                self._latest, self._taken_s = await self._view.take(), monotonic()
            return self._latest
