"""UDP 48899: answers to tools that look for AMS routers or request routes.

Rule: an answer is hardly longer than its request, so it cannot be used to flood a third host.
Hence server info has name and version only; the other fields that routers of others send (operating
system, fingerprint) are ten times as long, and no known tool needs them.

A requested route leads to the tool: its NetID, and the host where it serves AMS/TCP if it does.
A tool that only sends requests needs no such route, because answers return on its connection.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from ipaddress import IPv4Address
from time import monotonic
from typing import NamedTuple

from eap.ams.access import AddRoute, AuditedOperation, AuditEntry, Decision
from eap.ams.routes import Origin, RouteTable
from eap.ams.spec import (
    AccessService,
    HopSpec,
    RouteSpec,
    SecureRouteSpec,
    TransportKind,
)
from eap.codec.ads import AdsError
from eap.codec.ams import AMS_TCP_PORT, SYSTEM_PORT, AmsHeader
from eap.codec.amsdiscovery import (
    RESPONSE,
    TEMPORARY,
    Discovery,
    DiscoveryHeader,
    DiscoveryService,
    Tag,
    decode_discovery,
    decode_text,
    encode_discovery,
    encode_text,
    encode_version,
)
from eap.codec.secureads import AMS_TLS_PORT
from eap.errors import CodecError, ControlError, EnvironmentalError
from eap.ids import STATION_OCTETS, Endpoint, NetId, parse_host
from eap.net.limits import Rate, SourceRateLimiter, SourceRates
from eap.release import RELEASE
from eap.runtime.drop_counters import DropReason
from eap.services.limited_log import caused_by
from eap.services.routing.remote_routers import RouterRequests
from eap.services.routing.station_routes import StationRoutes
from eap.services.tasks import TaskSet
from eap.services.transports.route_logins import RouteLogins

# Requests beyond these rates get no answer, so that guessing passwords takes time.
RATES = SourceRates(
    source=Rate(10, 1.0),
    known=Rate(50, 5.0),
    new=Rate(10, 1.0),
    local=Rate(50, 10.0),
)
"""Requests that are decided."""
MAX_SOURCES = 1024
_SHOWN = 80

logger = logging.getLogger(__name__)


class _RouteRequest(NamedTuple):
    name: str
    net_id: NetId
    host: str
    port: int
    is_kept: bool


class RouteAdmin:
    """Handler of the add-route requests that come to one address.

    Args:
        stations: Routes of each station there; all of them get a route.
        logins: Logins of the process.
        clock: In seconds.
    """

    def __init__(
        self,
        stations: Sequence[StationRoutes],
        logins: RouteLogins,
        *,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self._stations = stations
        self._logins = logins
        self._clock = clock
        self._limiter = SourceRateLimiter(RATES, MAX_SOURCES, clock())

    async def handle(
        self, request: Discovery, sender: str, *, is_this_host: bool, fingerprint: str = ""
    ) -> AdsError | None:
        """Add the requested route, and return the result for its sender.

        None stands for no answer: the rate limit of the sender or of all senders is exceeded.

        Args:
            request: The datagram.
            sender: Its source IPv4 address.
            is_this_host: Whether a program of this host sent it.
            fingerprint: Of the sender's certificate, by Secure ADS; the route goes by it too.
        """
        now_s = self._clock()
        is_allowed = (
            self._limiter.take_local(now_s) if is_this_host else self._limiter.take(sender, now_s)
        )
        if not is_allowed:
            return None
        name = _text(request, Tag.ROUTE_NAME)[:_SHOWN]
        results = []
        endpoint = Endpoint(TransportKind.AMS_TLS if fingerprint else "ams-udp", sender)
        denials = await self._denials(request, sender, is_this_host=is_this_host)
        for station, denial in zip(self._stations, denials, strict=True):
            wanted = _audited(station.router.net_id, request, endpoint, AdsError.NONE, "")
            # Recorded before the change, because an audit that is required must not miss it.
            why = "" if denial else station.router.why_not_recorded(wanted)
            if why:
                result = AdsError.ACCESS
            else:
                result, why = await _decide(station, request, sender, denial, fingerprint)
            level = logging.INFO if result == AdsError.NONE else logging.WARNING
            cause = caused_by((station.router.net_id, name, sender, why), sender)
            logger.log(level, "route %r requested by %s: %s", name, sender, why, extra=cause)
            entry = _audited(station.router.net_id, request, endpoint, result, why)
            for write in station.router.on_audit:
                write(entry)
            # All stations decide, although only one answer is sent: the first error of them.
            results.append(result)
        return next((each for each in results if each != AdsError.NONE), AdsError.NONE)

    async def _denials(self, request: Discovery, sender: str, *, is_this_host: bool) -> list[str]:
        """Return why the sender may not add a route to each station; empty where it may."""
        with_users = [each.spec.users for each in self._stations if each.spec.users]
        refused: Iterator[str] = iter(())
        if with_users:
            user = _text(request, Tag.USER)
            password = (request.find(Tag.PASSWORD) or b"").partition(b"\0")[0]
            refused = iter(await self._logins.refusals(with_users, user, password, sender))
        closed = (
            "" if is_this_host else "the station has no users, so only this host may add routes"
        )
        return [next(refused) if each.spec.users else closed for each in self._stations]


def _audited(
    router: NetId, request: Discovery, endpoint: Endpoint, result: AdsError, why: str
) -> AuditEntry:
    """Return the entry of the audit about a request."""
    net_id = NetId((request.find(Tag.NET_ID) or b"")[:6].ljust(6, b"\0"))
    wanted = AddRoute(
        _text(request, Tag.ROUTE_NAME)[:_SHOWN],
        str(net_id),
        _text(request, Tag.HOST)[:_SHOWN],
        _text(request, Tag.USER)[:_SHOWN],
    )
    decision = Decision(AccessService.CONTROL, result != AdsError.ACCESS, why)
    header = AmsHeader(router, SYSTEM_PORT, net_id, 0, 0)
    done = AuditedOperation(wanted, decision, result)
    return AuditEntry(endpoint, header, "", (done,))


async def _decide(
    station: StationRoutes, request: Discovery, sender: str, denial: str, fingerprint: str
) -> tuple[AdsError, str]:
    """Return the result for the sender, and a text for the log."""
    if denial:
        # Tools expect 0x704 after a wrong password.
        return AdsError.ACCESS, f"refused: {denial}"
    try:
        wanted = _read(request, sender, AMS_TLS_PORT if fingerprint else AMS_TCP_PORT)
        configured = _configured(station.router.table, wanted.net_id)
        if configured:
            return AdsError.NONE, f"route {configured!r} of the plant file leads there"
        await _add(station, wanted, fingerprint)
    except (ValueError, ControlError) as exc:
        return AdsError.VALUE, f"refused: {exc}"
    except EnvironmentalError as exc:
        return AdsError.INTERNAL, f"not added: {exc}"
    return AdsError.NONE, f"added, to {wanted.net_id} at {wanted.host}:{wanted.port}"


def _text(request: Discovery, tag: int) -> str:
    return decode_text(request.find(tag) or b"")


def _read(request: Discovery, sender: str, usual_port: int) -> _RouteRequest:
    """Return the requested route; raise ValueError if its values are impossible."""
    octets = request.find(Tag.NET_ID) or b""
    if len(octets) != 6 or not any(octets):
        raise ValueError("the request has no NetID")
    where = _text(request, Tag.HOST).strip() or sender
    host, port = parse_host(where, usual_port)
    name = _text(request, Tag.ROUTE_NAME).strip() or where
    options = int.from_bytes((request.find(Tag.OPTIONS) or b"")[:4], "little")
    return _RouteRequest(name, NetId(octets), host, port, not options & TEMPORARY)


def _configured(table: RouteTable, net_id: NetId) -> str:
    """Return the name of the configured route to *net_id*, empty if there is none."""
    found = table.find(net_id)
    if found is None:
        return ""
    route, octets = found
    return route.name if octets and route.origin is Origin.STATIC else ""


async def _add(station: StationRoutes, wanted: _RouteRequest, fingerprint: str) -> None:
    """Add a route for all NetIDs of the requested station, or for the requested NetID alone."""
    kind = TransportKind.AMS_TLS if fingerprint else TransportKind.AMS_TCP
    hop = HopSpec(kind, "", f"{wanted.host}:{wanted.port}")
    is_here = station.has(wanted.net_id.station)
    spec = RouteSpec(
        name=wanted.name,
        net_id=str(wanted.net_id),
        hop=hop,
        # A tool on this host shares the first four bytes with the station: match all six then.
        octets=len(wanted.net_id) if is_here else STATION_OCTETS,
        is_probed=False,  # most tools answer no requests
        is_client=True,
        tls=SecureRouteSpec(fingerprint=fingerprint) if fingerprint else None,
    )
    await station.add(spec, is_kept=wanted.is_kept)


_VERSION = encode_version(RELEASE)
_LONGEST = 2048
_DATAGRAMS_PER_TURN = 64


class RouterName(NamedTuple):
    """Router that answers requests for server info."""

    name: str
    """Name of its station."""
    net_id: NetId


class AmsDiscovery:
    """Server for the datagrams to one address.

    Args:
        sock: Bound to that address by the supervisor; answers are sent by it, and it stays open.
        routers: Routers at that address.
        route_admin: Handles add-route requests.
        requests: Requests that were sent by *sock*, which receives their answers too.
        count_dropped: Counts a datagram without answer.
    """

    def __init__(
        self,
        sock: socket.socket,
        routers: Sequence[RouterName],
        route_admin: RouteAdmin,
        requests: RouterRequests,
        count_dropped: Callable[[DropReason], None],
    ) -> None:
        self._sock = sock
        self._own = sock.getsockname()[0]
        self._routers = routers
        self._route_admin = route_admin
        self._requests = requests
        self._count_dropped = count_dropped
        self._tasks = TaskSet("AMS discovery")
        self._watched: list[socket.socket] = []

    def watch(self, sock: socket.socket | None = None) -> None:
        """Answer datagrams as long as the running loop lives.

        With *sock* those that arrive there: broadcasts to the network of the address.
        """
        watched = self._sock if sock is None else sock
        watched.setblocking(False)
        self._watched.append(watched)
        asyncio.get_running_loop().add_reader(watched.fileno(), self._drain, watched)

    def stop(self) -> None:
        """Answer no more datagrams; the sockets stay open."""
        for sock in self._watched:
            asyncio.get_running_loop().remove_reader(sock.fileno())

    async def answers_to(self, data: bytes, sender: str) -> list[bytes]:
        """Return the answers to the datagram *data*: one for each router, or none."""
        try:
            request = decode_discovery(data)
        except CodecError:
            return []
        return [each async for each in self._answers(request, sender)]

    async def _answers(self, request: Discovery, sender: str) -> AsyncIterator[bytes]:
        service, number = request.header.service, request.header.invoke_id
        if service == DiscoveryService.SERVER_INFO:
            for router in self._routers:
                # The name first: some tools ignore the numbers of tags.
                name = Tag.HOST, encode_text(router.name)
                yield _answer(router, service, number, [name, (Tag.VERSION, _VERSION)])
        elif service == DiscoveryService.ADD_ROUTE:
            is_this_host = sender == self._own or IPv4Address(sender).is_loopback
            result = await self._route_admin.handle(request, sender, is_this_host=is_this_host)
            if result is not None:
                tag = Tag.RESULT, result.to_bytes(4, "little")
                yield _answer(self._routers[0], service, number, [tag])

    def _drain(self, sock: socket.socket) -> None:
        for _ in range(_DATAGRAMS_PER_TURN):
            try:
                data, sender = sock.recvfrom(_LONGEST)
            except BlockingIOError:
                return
            except OSError:
                continue  # ICMP error of an earlier answer
            # Both directions use port 48899, so answers to own requests arrive here too.
            if self._requests.receive(data, sender[0]):
                continue
            self._tasks.start(self._answer(data, sender))

    async def _answer(self, data: bytes, sender: tuple[str, int]) -> None:
        answers = await self.answers_to(data, sender[0])
        if not answers:
            self._count_dropped(DropReason.AMS_DISCOVERY)
        for answer in answers:
            try:
                self._sock.sendto(answer, sender)
            except OSError as exc:
                logger.debug("AMS router of %s: %s", sender[0], exc.strerror)


def _answer(
    router: RouterName, service: int, number: int, tags: Sequence[tuple[int, bytes]]
) -> bytes:
    header = DiscoveryHeader(0, number, service | RESPONSE, router.net_id, SYSTEM_PORT)
    return encode_discovery(header, tags)
