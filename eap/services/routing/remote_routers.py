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
from typing import NamedTuple

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
    """Router of another host that answered a scan."""

    name: str
    net_id: NetId
    address: str
    """IPv4 address of its host."""
    version: str
    """Of its software; empty if it sends none."""


class RemoteRouteRequest(NamedTuple):
    """Route that another router is requested to add: to a router of this host."""

    name: str
    net_id: NetId
    user: str
    password: str
    """Sent in clear text."""


class FoundRouter(NamedTuple):
    """Router that answered, and whether a route to it was learned."""

    neighbour: RemoteRouter
    is_learned: bool


async def scan_routers(
    scanners: Sequence[RouterRequests],
    learn: Callable[[NetId, str, str, int], bool],
    address: str,
    wait_s: float,
) -> list[FoundRouter]:
    """Scan for routers of other hosts, and learn routes to them.

    Args:
        scanners: Those of the scanning station.
        learn: Learns a route to a router; returns whether it was accepted.
        address: Host or network to scan; empty for the networks of the station.
        wait_s: Time limit for answers.

    Raises:
        EnvironmentalError: the station has no address to scan from, or sending failed.
    """
    _check(scanners)
    scans = [scanner.scan(address, wait_s=wait_s) for scanner in scanners]
    found: dict[NetId, RemoteRouter] = {}
    for each in await asyncio.gather(*scans):
        for neighbour in each:
            found.setdefault(neighbour.net_id, neighbour)
    now_ns = monotonic_ns()
    return [
        FoundRouter(each, learn(each.net_id, each.name, each.address, now_ns))
        for each in found.values()
    ]


async def add_remote_route(
    scanners: Sequence[RouterRequests],
    wanted: RemoteRouteRequest,
    address: IPv4Address,
    wait_s: float,
) -> int | None:
    """Request the route *wanted* at the router of *address*, from the station's nearest address.

    Returns:
        The ADS result; None without answer.

    Raises:
        EnvironmentalError: the station has no address to send from, or sending failed.
    """
    _check(scanners)
    # The longest common prefix, as in a routing table.
    nearest = min(scanners, key=lambda each: int(each.address) ^ int(address))
    return await nearest.add_remote_route(wanted, str(address), wait_s=wait_s)


def _check(scanners: Sequence[RouterRequests]) -> None:
    if not scanners:
        raise EnvironmentalError("the station has no IP address at which it serves AMS")


MAX_ROUTERS = 1024
"""Limit of the answers to one scan."""
BROADCAST = "255.255.255.255"
_MAX_NAME = 80


class _RouterRequest:
    """Pending request; *wanted* is the number of answers that completes it, 0 for none."""

    def __init__(
        self, service: int, receive: Callable[[Discovery, str], None], wanted: int
    ) -> None:
        self.service = service
        self.receive = receive
        self.wanted = wanted
        self.is_answered = asyncio.Event()


class RouterRequests:
    """Requests from one address, with their answers.

    Args:
        sock: Bound to that address; its reader calls :meth:`receive`.
        own: NetIDs of the local routers; the first of them is the source.
    """

    def __init__(self, sock: socket.socket, own: Sequence[NetId]) -> None:
        self.address = IPv4Address(sock.getsockname()[0])
        self._sock = sock
        self._own: Collection[NetId] = frozenset(own)
        self._net_id = own[0]
        self._waiting: dict[int, _RouterRequest] = {}

    async def scan(
        self, address: str = "", *, wait_s: float, port: int = AMS_UDP_PORT
    ) -> list[RemoteRouter]:
        """Request server info, and return the routers that answered in time.

        Args:
            address: Host or network to scan; empty for the network of this address.
            wait_s: Time limit for answers.
            port: UDP port of the routers.

        Raises:
            EnvironmentalError: sending failed.
        """
        found: dict[NetId, RemoteRouter] = {}

        def receive(answer: Discovery, sender: str) -> None:
            net_id = answer.header.net_id
            # A router also receives its own broadcasts; a zero NetID names no router.
            if any(net_id) and net_id not in self._own and len(found) < MAX_ROUTERS:
                # The router itself answers first; later ones answer in its place.
                found.setdefault(net_id, _router_of(answer, sender))

        request = _RouterRequest(DiscoveryService.SERVER_INFO, receive, 0)
        target = address or network_of(str(self.address))
        await self._send(request, [], (target, port), wait_s)
        return list(found.values())

    async def add_remote_route(
        self, wanted: RemoteRouteRequest, address: str, *, wait_s: float, port: int = AMS_UDP_PORT
    ) -> int | None:
        """Request a route to a local router at the router of *address*.

        Args:
            wanted: The route, with the user and the password.
            address: IPv4 address of the other router.
            wait_s: Time limit for the answer.
            port: Its UDP port.

        Returns:
            The ADS result; None without answer.

        Raises:
            EnvironmentalError: sending failed.
        """
        results: list[int] = []

        def receive(answer: Discovery, sender: str) -> None:
            # Any host can send a datagram, but only the requested router knows the result.
            if sender == address:
                results.append(int.from_bytes((answer.find(Tag.RESULT) or b"")[:4], "little"))

        tags = [
            (Tag.ROUTE_NAME, encode_text(wanted.name)),
            (Tag.NET_ID, bytes(wanted.net_id)),
            (Tag.USER, encode_text(wanted.user)),
            (Tag.PASSWORD, encode_text(wanted.password)),
            (Tag.HOST, encode_text(str(self._seen_from(address)))),
        ]
        request = _RouterRequest(DiscoveryService.ADD_ROUTE, receive, 1)
        await self._send(request, tags, (address, port), wait_s)
        return results[0] if results else None

    def receive(self, data: bytes, sender: str) -> bool:
        """Match a received datagram with the pending requests; return whether it answers one."""
        if not self._waiting:
            return False
        try:
            answer = decode_discovery(data)
        except CodecError:
            return False
        number = answer.header.invoke_id
        # Some routers return 0 in place of the invoke id: then the service code alone decides.
        pending = [self._waiting.get(number)] if number else [*self._waiting.values()]
        found = [
            each
            for each in pending
            if each is not None and answer.header.service == each.service | RESPONSE
        ]
        for request in found:
            request.receive(answer, sender)
            request.wanted -= 1
            if not request.wanted:
                request.is_answered.set()
        return bool(found)

    async def _send(
        self,
        request: _RouterRequest,
        tags: Sequence[tuple[int, bytes]],
        target: tuple[str, int],
        wait_s: float,
    ) -> None:
        # Random, so that other hosts cannot guess it; 0 means no number.
        number = secrets.randbits(32) or 1
        header = DiscoveryHeader(0, number, request.service, self._net_id, SYSTEM_PORT)
        self._waiting[number] = request
        try:
            self._sock.sendto(encode_discovery(header, tags), target)
            async with asyncio.timeout(wait_s):
                await request.is_answered.wait()
        except TimeoutError:
            pass
        except OSError as exc:
            reason = f"no request to {target[0]} from {self.address}: {exc.strerror or exc}"
            raise EnvironmentalError(reason) from None
        finally:
            del self._waiting[number]

    def _seen_from(self, address: str) -> IPv4Address:
        """Return the address of this host from which packets to *address* are sent."""
        if not self.address.is_unspecified:
            return self.address
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.connect((address, AMS_UDP_PORT))  # connect() of a datagram socket sends no packet
            return IPv4Address(trial.getsockname()[0])


def network_of(address: str) -> str:
    """Return the broadcast address of the network of a local *address*."""
    is_any = IPv4Address(address).is_unspecified  # its networks may change later
    # A directed broadcast leaves by the interface of that network only.
    return BROADCAST if is_any else broadcast_of(address) or BROADCAST


def _router_of(answer: Discovery, sender: str) -> RemoteRouter:
    name = "".join(filter(str.isprintable, decode_text(answer.find(Tag.HOST) or b"")))
    version = decode_version(answer.find(Tag.VERSION) or b"")
    return RemoteRouter(name[:_MAX_NAME], answer.header.net_id, sender, version)
