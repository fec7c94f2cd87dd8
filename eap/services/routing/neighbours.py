"""Routers of other hosts: who answers a question to a network, and the routes that come of it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import NamedTuple, Protocol

from eap.errors import EnvironmentalError
from eap.ids import NetId


class Neighbour(NamedTuple):
    """A router of another host that answered."""

    name: str
    net_id: NetId
    address: str
    """IPv4 address of its host."""
    version: str
    """Of its software, empty if it does not tell."""


class Introduction(NamedTuple):
    """A route that another router is asked for: to a router here."""

    name: str
    net_id: NetId
    user: str
    password: str
    """It is sent in clear."""


class Scanner(Protocol):
    """Asks for the routers of other hosts."""

    @property
    def address(self) -> IPv4Address:
        """That it asks from."""

    async def scan(self, address: str = "", *, wait_s: float) -> list[Neighbour]:
        """Ask at *address*, or in a network, and return who answered in time."""

    async def introduce(self, wanted: Introduction, address: str, *, wait_s: float) -> int | None:
        """Ask the router at *address* for a route; return its result, None if it says nothing."""


class Learner(Protocol):
    """Takes routes to those who answered."""

    @property
    def scanners(self) -> Sequence[Scanner]:
        """One for each address of the station."""

    def learn(self, net_id: NetId, name: str, address: str, now_ns: int) -> bool:
        """Take a route; tell whether it was taken."""


class Found(NamedTuple):
    """Who answered, and whether a route there was learned of it."""

    neighbour: Neighbour
    is_learned: bool


async def find_neighbours(station: Learner, address: str, wait_s: float) -> list[Found]:
    """Ask who else is there, and learn routes to them.

    Args:
        station: The routes of a station.
        address: Of a host or a network to ask; the networks of the station if empty.
        wait_s: How long to wait for answers.

    Raises:
        EnvironmentalError: nobody can be asked.
    """
    _check(station.scanners)
    scans = [scanner.scan(address, wait_s=wait_s) for scanner in station.scanners]
    found: dict[NetId, Neighbour] = {}
    for each in await asyncio.gather(*scans):
        for neighbour in each:
            found.setdefault(neighbour.net_id, neighbour)
    now_ns = monotonic_ns()
    return [
        Found(each, station.learn(each.net_id, each.name, each.address, now_ns))
        for each in found.values()
    ]


async def introduce(
    station: Learner, wanted: Introduction, address: IPv4Address, wait_s: float
) -> int | None:
    """Ask the router at *address* for the route *wanted*, from the station's nearest address.

    Returns:
        What it says, an ADS result; None if it says nothing.

    Raises:
        EnvironmentalError: it cannot be asked.
    """
    _check(station.scanners)
    nearest = min(station.scanners, key=lambda each: int(each.address) ^ int(address))
    return await nearest.introduce(wanted, str(address), wait_s=wait_s)


def _check(scanners: Sequence[Scanner]) -> None:
    if not scanners:
        raise EnvironmentalError("the station has no IP address at which it serves AMS")
