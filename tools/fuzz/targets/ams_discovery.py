"""Datagrams of UDP port 48899, and the routes that they add."""

from __future__ import annotations

import asyncio
import logging
import socket
from pathlib import Path

from eap.ams.spec import AmsUser, RouteSpec, RoutingSpec
from eap.codec.amsdiscovery import (
    decode_discovery,
    decode_text,
    decode_version,
    encode_discovery,
    encode_text,
)
from eap.errors import CodecError
from eap.ids import NetId
from eap.runtime.drop_counters import DropReason
from eap.runtime.store import StationFile
from eap.services.routing.remote_routers import RouterRequests
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.transports.ams_discovery import AmsDiscovery, RouteAdmin, RouterName
from eap.services.transports.route_logins import RouteLogins

OWN = NetId.parse("10.0.0.1.1.1")
_MAX_ANSWER = 64
_PASSWORD = "/dev/null"  # noqa: S105  a file: nobody's password is right

logging.getLogger("eap").addHandler(logging.NullHandler())


class _Store(StationFile[tuple[RouteSpec, ...]]):
    """Keeps nothing."""

    def __init__(self) -> None:
        self.path = Path()

    def read(self) -> tuple[RouteSpec, ...]:
        return ()

    def save(self, value: tuple[RouteSpec, ...]) -> None:
        del value


def fuzz_one(data: bytes) -> None:
    """Read a datagram and write it again, then answer it; only CodecError may pass."""
    try:
        read = decode_discovery(data)
    except CodecError:
        pass
    else:
        if not data.startswith(encode_discovery(read.header, read.tags)):
            raise AssertionError("the datagram encodes to other octets")
        for _, content in read.tags:
            decode_version(content)
            text = decode_text(content)
            if decode_text(encode_text(text)) != text:
                raise AssertionError(f"{text!r} is read as another text")
    for users in ((), (AmsUser("Administrator", _PASSWORD),)):
        asyncio.run(_answer(data, users))


async def _answer(data: bytes, users: tuple[AmsUser, ...]) -> None:
    """Answer *data* from this host twice: the second time changes nothing."""
    routes = StationRoutes(StationRouter("left", OWN), RoutingSpec(users=users), _Store())
    refused: list[DropReason] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        route_admin = RouteAdmin([routes], RouteLogins())
        requests = RouterRequests(sock, [OWN])
        if requests.receive(data, "127.0.0.1"):
            raise AssertionError("the answer to a question that was not asked")
        routers = [RouterName("left", OWN)]
        discovery = AmsDiscovery(sock, routers, route_admin, requests, refused.append)
        answers = await discovery.answers_to(data, "127.0.0.1")
        added = routes.added
        again = await discovery.answers_to(data, "127.0.0.1")
        if again != answers or routes.added != added:
            raise AssertionError("the same datagram does another thing the second time")
    if any(len(each) > _MAX_ANSWER for each in answers):
        raise AssertionError(f"an answer of {max(map(len, answers))} octets")
    if added and users:
        raise AssertionError("a route was added without a password")
    if any(route.net_id in routes.router.net_ids for route in routes.router.table):
        raise AssertionError("a route leads to the station itself")
