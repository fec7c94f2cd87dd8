"""The page, or metrics alone, as a process: of the supervisor, or by hand with ``eapctl web``.

It only looks at the appliance by the control protocol, so it may end at any moment.
"""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import ssl
from collections.abc import Callable, Mapping
from pathlib import Path

from aiohttp import web

from eap.config.listen import parse_listen
from eap.config.web_sections import MetricsSection, WebSection
from eap.errors import EnvironmentalError
from eap.live.client import LiveClient
from eap.live.view import LiveView
from eap.runtime.durable import whole_file
from eap.runtime.handover import WebHandover
from eap.runtime.lifetime import wait_for_end
from eap.runtime.log import LevelFile, start_logging
from eap.runtime.startup import Startup
from eap.runtime.store import plant_folder
from eap.web.metrics import PATH, MetricsServer
from eap.web.server import PageServer, open_listener, serving, tls_context
from eap.web.sessions import KEY_BYTES

logger = logging.getLogger(__name__)


def main(descriptor: int, startup: Startup) -> int:
    """Serve page or metrics of an appliance until SIGTERM, or until its supervisor ends."""
    handover = WebHandover.from_descriptor(descriptor)
    section = handover.web or handover.metrics or WebSection()
    start_logging(section.KEY)
    startup.step(f"opening the port of {section.KEY}")
    try:
        listener = open_listener(section)
        context = tls_context(section)
    except EnvironmentalError as exc:
        startup.step(str(exc))
        return 2

    levels = LevelFile(Path(handover.folder))

    def beat() -> None:
        startup.beat()
        levels.follow(section.KEY)

    def ready() -> None:
        startup.finish({"url": page_url(section)}, is_watched=True)

    run(
        section,
        handover.plant,
        listener,
        context,
        ready=ready,
        beat=beat,
        parent=handover.supervisor,
    )
    return 0


def page_url(section: WebSection | MetricsSection) -> str:
    """Return the address of page or metrics for a browser of this host."""
    url = parse_listen(section.listen).url("https" if section.tls else "http")
    return url if isinstance(section, WebSection) else f"{url}{PATH[1:]}"


def run(
    section: WebSection | MetricsSection,
    plant: str,
    listener: socket.socket,
    context: ssl.SSLContext | None,
    *,
    ready: Callable[[], None],
    beat: Callable[[], None] = lambda: None,
    remote: Mapping[str, LiveClient] = {},
    parent: int = 0,
) -> None:
    """Serve a page, or metrics, until SIGINT or SIGTERM.

    Args:
        section: The key ``web`` or ``metrics``.
        plant: Its appliances on this host are shown; all if empty.
        listener: The listening socket.
        context: TLS settings.
        ready: Called when it serves.
        beat: Called every ``LIFE_PERIOD_S`` from then on.
        remote: Remote appliances, which are shown instead.
        parent: Process without which it ends; 0 for none.
    """
    with listener:
        asyncio.run(_serve(section, plant, listener, context, ready, beat, remote, parent))


async def _serve(
    section: WebSection | MetricsSection,
    plant: str,
    listener: socket.socket,
    context: ssl.SSLContext | None,
    ready: Callable[[], None],
    beat: Callable[[], None],
    remote: Mapping[str, LiveClient],
    parent: int,
) -> None:
    async with (
        LiveView(plant, remote) as view,
        serving(_application(section, plant, view), listener, context),
    ):
        ready()
        await wait_for_end(asyncio.Event(), parent, beat)


def _application(
    section: WebSection | MetricsSection, plant: str, view: LiveView
) -> web.Application:
    if isinstance(section, WebSection):
        return PageServer(section, view, session_key(plant)).application()
    return MetricsServer(section, view).application()


def session_key(plant: str) -> bytes:
    """Return the secret of the sessions of a plant's page, kept so that they outlive a restart."""
    path = plant_folder(plant or "web") / "web.key"
    try:
        if (key := _read_key(path)) is not None:
            return key
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        key = secrets.token_bytes(KEY_BYTES)
        with whole_file(path) as file:
            # Before there is content: other users must not read it even for a moment.
            os.fchmod(file.fileno(), 0o600)
            file.write(key)
    except (OSError, EnvironmentalError) as exc:
        logger.warning("sessions end with this process: %s cannot be kept: %s", path, exc)
        return secrets.token_bytes(KEY_BYTES)
    return key


def _read_key(path: Path) -> bytes | None:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    with os.fdopen(fd, "rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        # One byte more, so that a file that is too long is noticed.
        key = file.read(KEY_BYTES + 1)
    # Anyone who read it could make sessions of every user.
    return key if len(key) == KEY_BYTES and not mode & 0o077 else None
