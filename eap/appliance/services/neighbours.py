"""Routers of other hosts: who answers a question to a network, and the routes that come of it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
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


class Scanner(Protocol):
    """Asks for the routers of other hosts."""

    async def scan(self, address: str = "", *, wait_s: float) -> list[Neighbour]:
        """Ask at *address*, or in a network, and return who answered in time."""


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
    if not station.scanners:
        raise EnvironmentalError("the station has no IP address at which it serves AMS")
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
