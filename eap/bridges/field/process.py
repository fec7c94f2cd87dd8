"""A bridge to controllers of one protocol: its clients, which follow the plant, and its server."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from functools import partial
from time import time
from typing import Literal, TypeVar

from eap.bridges.bridge import Bridge
from eap.bridges.field.client import ControllerPoints, FieldClient
from eap.bridges.field.memory import ServedMemory
from eap.bridges.field.plan import PointKey
from eap.bridges.field.protocol import FieldLink, FieldSession
from eap.bridges.field.server import FieldServing
from eap.bridges.values import Sample
from eap.codec import datatypes
from eap.codec.fieldaddresses import FieldPoint
from eap.config.bridge_sections import FieldServer, ModbusController, S7Controller
from eap.config.field import address_point
from eap.control.field import FIELD_POINTS, FieldPointRow
from eap.errors import EapError
from eap.runtime.bridges import PeerStatus

FOLLOW_S = 5.0
"""Period in which changed sources and targets are noticed."""
_RETRY_S = 0.5
_UNKNOWN = "the controller was added while the plant ran; restart the appliance"

ControllerT = TypeVar("ControllerT", S7Controller, ModbusController)

logger = logging.getLogger(__name__)


async def run_field(
    bridge: Bridge,
    key: Literal["s7", "modbus"],
    controllers: Mapping[str, ControllerT],
    server: FieldServer | None,
    make_link: Callable[[ControllerT], FieldLink],
    make_session: Callable[[ServedMemory], FieldSession],
) -> None:
    """Run clients and server until cancelled.

    Args:
        bridge: The plant.
        key: Of the bridge.
        controllers: By their names.
        server: What is served, None for nothing.
        make_link: Makes the conversations of a connection to a controller.
        make_session: Makes the answers to one client of the server.

    Raises:
        EnvironmentalError: the port of the server cannot be opened.
    """
    async with asyncio.TaskGroup() as group:
        if server is not None:
            group.create_task(FieldServing(bridge, server, key, make_session).run())
        else:
            bridge.ready()
        # Controllers may be away for as long as they like: the bridge is ready without them.
        group.create_task(_follow(bridge, key, controllers, make_link))


async def _follow(
    bridge: Bridge,
    key: Literal["s7", "modbus"],
    controllers: Mapping[str, ControllerT],
    make_link: Callable[[ControllerT], FieldLink],
) -> None:
    """Run a client for each controller, others when sources or targets change."""
    known: list[FieldPointRow] | None = None
    running: asyncio.Task[None] | None = None
    try:
        async with asyncio.TaskGroup() as group:
            while True:
                pause_s = FOLLOW_S
                try:
                    rows = await bridge.call(FIELD_POINTS, bridge=key)
                except EapError as exc:
                    logger.debug("sources and targets: %s", exc)
                    pause_s = _RETRY_S
                else:
                    if rows != known:
                        if running is not None:
                            running.cancel()
                            # Its connections end first: a controller may allow only a few.
                            await asyncio.wait([running])
                        known = rows
                        running = group.create_task(_run(bridge, key, controllers, rows, make_link))
                await asyncio.sleep(pause_s)
    finally:
        bridge.status.peers = []


async def _run(
    bridge: Bridge,
    key: str,
    controllers: Mapping[str, ControllerT],
    rows: list[FieldPointRow],
    make_link: Callable[[ControllerT], FieldLink],
) -> None:
    clients: dict[str, FieldClient] = {}
    peers = []
    for name, controller in controllers.items():
        points = _points(rows, name, controller)
        if not (points.sources or points.targets or points.wrong):
            continue
        url = f"{key}://{controller.host}:{controller.port}"
        status = PeerStatus(name=name, url=url)
        peers.append(status)
        make = partial(make_link, controller)
        clients[name] = FieldClient(bridge, controller, controller.port, points, status, make)
    # Of a change of the running plant: this process got its controllers at the start.
    unknown = sorted({row.controller for row in rows} - controllers.keys())
    peers += [PeerStatus(name=name, reason=_UNKNOWN, since=time()) for name in unknown]
    bridge.status.peers = peers
    targets: dict[str, list[tuple[FieldClient, PointKey]]] = {}
    for row in rows:
        if row.is_target and row.controller in clients:
            found = clients[row.controller], PointKey(row.station, row.variable)
            targets.setdefault(f"{row.station}/{row.variable}", []).append(found)

    def pass_on(samples: Mapping[str, Sample]) -> None:
        for name, sample in samples.items():
            for client, point in targets.get(name, ()) if sample.has_value else ():
                client.set(point, sample.value)

    async with asyncio.TaskGroup() as group:
        for client in clients.values():
            group.create_task(client.run())
        if targets:
            # One feed serves all: the fastest controller decides how often it looks.
            period_ms = min(each.every_ms for each in controllers.values())
            group.create_task(bridge.feed(targets, period_ms, on_values=pass_on).run())


def _points(
    rows: list[FieldPointRow], name: str, controller: S7Controller | ModbusController
) -> ControllerPoints:
    sources: dict[PointKey, FieldPoint] = {}
    targets: dict[PointKey, FieldPoint] = {}
    wrong: dict[PointKey, str] = {}
    for row in rows:
        if row.controller != name:
            continue
        key = PointKey(row.station, row.variable)
        try:
            point = address_point(datatypes.parse(row.kind), row.address, row.type, controller)
        except ValueError as exc:
            # A variable that got another type since the plant was checked.
            wrong[key] = f"{row.station}/{row.variable}: {exc}"
        else:
            (targets if row.is_target else sources)[key] = point
    return ControllerPoints(sources, targets, wrong)
