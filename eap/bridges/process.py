"""Run of a bridge as a process of the supervisor: start, signals, end."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec

from eap.bridges.bridge import Bridge
from eap.errors import EnvironmentalError
from eap.ids import decode_value
from eap.live.client import LiveClient
from eap.live.transport import UnixConnection
from eap.runtime.bridges import BridgeFile
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import BridgeHandover
from eap.runtime.lifetime import wait_for_end
from eap.runtime.log import LevelFile, start_logging
from eap.runtime.startup import Startup

SectionT = TypeVar("SectionT", bound=msgspec.Struct)


def run_bridge(
    descriptor: int,
    startup: Startup,
    kind: type[SectionT],
    serve: Callable[[Bridge, SectionT], Awaitable[None]],
) -> int:
    """Run a bridge until SIGTERM, or until its supervisor ends; return the exit code.

    Args:
        descriptor: Handover of the supervisor.
        startup: For reports of the start.
        kind: Type of its section of the plant file.
        serve: The bridge.  It calls ``ready`` when it runs, and is cancelled to end, for which it
            has 0.8 s.  It may raise EnvironmentalError: the supervisor starts it again after a
            pause, and ``status`` has the reason.
    """
    handover = BridgeHandover.from_descriptor(descriptor)
    start_logging(handover.name)
    section = msgspec.json.decode(handover.section, type=kind, dec_hook=decode_value)
    folder = ApplianceFolder(Path(handover.folder))
    startup.step(f"starting {handover.name}")

    def connect() -> LiveClient:
        return LiveClient(partial(UnixConnection.open, folder.control_socket))

    levels = LevelFile(folder.path)

    def beat() -> None:
        startup.beat()
        levels.follow(handover.name)

    async def run() -> str:
        bridge = Bridge(
            handover.plant,
            folder.path.name,
            connect,
            ready=partial(startup.finish, {}, is_watched=True),
            file=BridgeFile(folder.path, handover.name),
            pid=os.getpid(),
        )
        reason = ""
        try:
            await _run(bridge, serve(bridge, section), beat, handover.supervisor)
        except* EnvironmentalError as group:
            reason = str(group.exceptions[0])
            if not bridge.is_ready:
                startup.step(reason)
        return reason

    # Reasons outside of this program, such as a port that is in use, need no traceback.
    if reason := asyncio.run(run()):
        logging.getLogger(__name__).error("%s", reason)
        return 2
    return 0


async def _run(
    bridge: Bridge, work: Awaitable[None], beat: Callable[[], None], parent: int
) -> None:
    ended = asyncio.Event()

    async def serve() -> None:
        try:
            await work
        finally:
            ended.set()

    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(each) for each in (bridge.report(), serve())]
        # Until it is ready its steps are watched: a sign of life would hide that one of them hangs.
        await wait_for_end(ended, parent, lambda: beat() if bridge.is_ready else None)
        for task in tasks:
            task.cancel()
