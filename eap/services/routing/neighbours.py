"""Requests to routers of other hosts by UDP 48899: server info, and routes to this host.

Routers and tools send the same datagrams.  The invoke id of a request comes back with its answer,
or 0 from routers that do not support it.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Callable, Collection, Sequence
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import NamedTuple, Protocol

from eap.codec.ams import SYSTEM_PORT
from eap.codec.amsdiscovery import (
    AMS_UDP_PORT,
    RESPONSE,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    decode_text,
    decode_version,
    encode_discovery,
    encode_text,
)
from eap.errors import CodecError, EnvironmentalError
from eap.ids import NetId
from eap.net.interface import broadcast_of


class RemoteRouter(NamedTuple):
    """A router of another host that answered."""

    name: str
    net_id: NetId
    address: str
    """IPv4 address of its host."""
    version: str
    """Of its software, empty if it does not tell."""


class RemoteRouteRequest(NamedTuple):
    """A route that another router is asked for: to a router here."""

    name: str
    net_id: NetId
    user: str
    password: str
    """It is sent in clear."""


class NeighbourScanner(Protocol):
    """Asks for the routers of other hosts."""

    @property
    def address(self) -> IPv4Address:
        """That it asks from."""

    async def scan(self, address: str = "", *, wait_s: float) -> list[RemoteRouter]:
        """Ask at *address*, or in a network, and return who answered in time."""

    async def add_remote_route(
        self, wanted: RemoteRouteRequest, address: str, *, wait_s: float
    ) -> int | None:
        """Ask the router at *address* for a route; return its result, None if it says nothing."""


class LearningStation(Protocol):
    """Takes routes to those who answered."""

    @property
    def scanners(self) -> Sequence[NeighbourScanner]:
        """One for each address of the station."""

    def learn(self, net_id: NetId, name: str, address: str, now_ns: int) -> bool:
        """Take a route; tell whether it was taken."""


class FoundRouter(NamedTuple):
    """Who answered, and whether a route there was learned of it."""

    neighbour: RemoteRouter
    is_learned: bool


async def scan_routers(station: LearningStation, address: str, wait_s: float) -> list[FoundRouter]:
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
    found: dict[NetId, RemoteRouter] = {}
    for each in await asyncio.gather(*scans):
        for neighbour in each:
            found.setdefault(neighbour.net_id, neighbour)
    now_ns = monotonic_ns()
    return [
        FoundRouter(each, station.learn(each.net_id, each.name, each.address, now_ns))
        for each in found.values()
    ]


async def add_remote_route(
    station: LearningStation, wanted: RemoteRouteRequest, address: IPv4Address, wait_s: float
) -> int | None:
    """Ask the router at *address* for the route *wanted*, from the station's nearest address.

    Returns:
        What it says, an ADS result; None if it says nothing.

    Raises:
        EnvironmentalError: it cannot be asked.
    """
    _check(station.scanners)
    nearest = min(station.scanners, key=lambda each: int(each.address) ^ int(address))
    return await nearest.add_remote_route(wanted, str(address), wait_s=wait_s)


def _check(scanners: Sequence[NeighbourScanner]) -> None:
    if not scanners:
        raise EnvironmentalError("the station has no IP address at which it serves AMS")


MAX_NEIGHBOURS = 1024
"""Answers to one question that are taken."""
BROADCAST = "255.255.255.255"
_MAX_NAME = 80


class _PendingRequest:
    """One question on its way; *wanted* is how many answers end the waiting, 0 for none."""

    def __init__(self, service: int, take: Callable[[Discovery, str], None], wanted: int) -> None:
        self.service = service
        self.take = take
        self.wanted = wanted
        self.is_answered = asyncio.Event()


class RouterRequests:
    """Asks from one address.

    Args:
        sock: Bound to that address; somebody else reads it.
        own: NetIDs of the routers there, the first of them asks.
    """

    def __init__(self, sock: socket.socket, own: Sequence[NetId]) -> None:
        self.address = IPv4Address(sock.getsockname()[0])
        self._sock = sock
        self._own: Collection[NetId] = frozenset(own)
        self._net_id = own[0]
        self._waiting: dict[int, _PendingRequest] = {}

    async def scan(
        self, address: str = "", *, wait_s: float, port: int = AMS_UDP_PORT
    ) -> list[RemoteRouter]:
        """Ask who is there, and return who answered in time.

        Args:
            address: Of a host or a network; the network of this address if empty.
            wait_s: How long to wait for answers.
            port: UDP port of the routers.

        Raises:
            EnvironmentalError: the question cannot be sent.
        """
        found: dict[NetId, RemoteRouter] = {}

        def take(answer: Discovery, sender: str) -> None:
            net_id = answer.header.net_id
            if any(net_id) and net_id not in self._own and len(found) < MAX_NEIGHBOURS:
                # Who answers for somebody else comes later than that one.
                found.setdefault(net_id, _neighbour(answer, sender))

        question = _PendingRequest(DiscoveryService.SERVER_INFO, take, 0)
        target = address or network_of(str(self.address))
        await self._ask(question, [], (target, port), wait_s)
        return list(found.values())

    async def add_remote_route(
        self, wanted: RemoteRouteRequest, address: str, *, wait_s: float, port: int = AMS_UDP_PORT
    ) -> int | None:
        """Ask the router at *address* for a route to one here.

        Args:
            wanted: The route, and who asks.
            address: IPv4 address of the other router.
            wait_s: How long to wait.
            port: Its UDP port.

        Returns:
            What it says, an ADS result; None if it says nothing.

        Raises:
            EnvironmentalError: the question cannot be sent.
        """
        results: list[int] = []

        def take(answer: Discovery, sender: str) -> None:
            if sender == address:
                results.append(int.from_bytes((answer.find(Tag.RESULT) or b"")[:4], "little"))

        tags = [
            (Tag.ROUTE_NAME, encode_text(wanted.name)),
            (Tag.NET_ID, bytes(wanted.net_id)),
            (Tag.USER, encode_text(wanted.user)),
            (Tag.PASSWORD, encode_text(wanted.password)),
            (Tag.HOST, encode_text(str(self._seen_from(address)))),
        ]
        question = _PendingRequest(DiscoveryService.ADD_ROUTE, take, 1)
        await self._ask(question, tags, (address, port), wait_s)
        return results[0] if results else None

    def take(self, data: bytes, sender: str) -> bool:
        """Take *data* for an answer to a question; tell whether it is one."""
        if not self._waiting:
            return False
        try:
            answer = decode_discovery(data)
        except CodecError:
            return False
        number = answer.header.invoke_id
        asked = [self._waiting.get(number)] if number else [*self._waiting.values()]
        found = [
            each
            for each in asked
            if each is not None and answer.header.service == each.service | RESPONSE
        ]
        for question in found:
            question.take(answer, sender)
            question.wanted -= 1
            if not question.wanted:
                question.is_answered.set()
        return bool(found)

    async def _ask(
        self,
        question: _PendingRequest,
        tags: Sequence[tuple[int, bytes]],
        target: tuple[str, int],
        wait_s: float,
    ) -> None:
        number = secrets.randbits(32) or 1
        header = DiscoveryHeader(0, number, question.service, self._net_id, SYSTEM_PORT)
        self._waiting[number] = question
        try:
            self._sock.sendto(encode_discovery(header, tags), target)
            async with asyncio.timeout(wait_s):
                await question.is_answered.wait()
        except TimeoutError:
            pass
        except OSError as exc:
            reason = f"{target[0]} cannot be asked from {self.address}: {exc.strerror or exc}"
            raise EnvironmentalError(reason) from None
        finally:
            del self._waiting[number]

    def _seen_from(self, address: str) -> IPv4Address:
        """Return by which address of this host the one at *address* reaches it."""
        if not self.address.is_unspecified:
            return self.address
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.connect((address, AMS_UDP_PORT))  # which sends nothing
            return IPv4Address(trial.getsockname()[0])


def network_of(address: str) -> str:
    """Return where all hosts beside *address* of this machine are asked."""
    is_any = IPv4Address(address).is_unspecified  # whatever network is there then
    return BROADCAST if is_any else broadcast_of(address) or BROADCAST


def _neighbour(answer: Discovery, sender: str) -> RemoteRouter:
    name = "".join(filter(str.isprintable, decode_text(answer.find(Tag.HOST) or b"")))
    version = decode_version(answer.find(Tag.VERSION) or b"")
    return RemoteRouter(name[:_MAX_NAME], answer.header.net_id, sender, version)
