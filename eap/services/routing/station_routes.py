"""Routes of one station: configured in the plant file, added at run time, and learned.

Rule: a configured route has precedence over all others.  An added route is stored over restarts, a
learned one is not.
Rule: a change is stored before it is in force, and reported after that.  Packets do not wait for
the disk, which takes milliseconds; the next change does.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from ipaddress import IPv4Address

from msgspec.structs import replace

from eap.ads.request import Operation, Write, WriteControl
from eap.ams.access import AccessList
from eap.ams.routes import Origin, Route
from eap.ams.spec import (
    AccessRule,
    HopSpec,
    MqttSpec,
    RouteSpec,
    RoutingSpec,
    SecureRouteSpec,
    TransportKind,
)
from eap.codec.ads import IndexGroup
from eap.codec.ams import AMS_TCP_PORT, IO_PORT
from eap.codec.ethercat import EAP_PORT
from eap.control.protocol import WriteOrigin
from eap.errors import ControlError
from eap.ids import STATION_OCTETS, Destination, DestinationKind, Endpoint, NetId, prefix_text
from eap.net.interface import own_addresses
from eap.pd.spec import StationSpec
from eap.runtime.store import StationFile
from eap.services.routing.remote_routers import RouterRequests
from eap.services.routing.station_router import StationRouter
from eap.services.tasks import JobQueue

_IP_SCHEMES = ("udp", "tcp")
_ADDRESSES = {
    TransportKind.UDP: (DestinationKind.IP,),
    TransportKind.TCP: (DestinationKind.IP,),
    TransportKind.ETHERNET: (DestinationKind.MAC, DestinationKind.NET_ID),
}


def make_router(station: StationSpec, routing: RoutingSpec) -> StationRouter:
    """Return the router of a station, without services and routes."""
    net_id = station.net_id
    net_ids = [port.net_id for port in station.ports]
    return StationRouter(station.name, net_id, net_ids, access=access_of(station, routing))


def to_route(spec: RouteSpec, hop: Endpoint, origin: Origin) -> Route:
    """Return the route of *spec* by *hop*; raise ValueError if its values are impossible."""
    net_id = NetId.parse(spec.net_id)
    return Route(
        NetId.parse(spec.virtual) if spec.virtual else net_id,
        spec.name,
        hop,
        origin,
        spec.octets,
        spec.is_unidirectional,
        real=net_id if spec.virtual else None,
        timeout_ns=spec.timeout_ms * 1_000_000,
        is_probed=spec.is_probed,
        router=NetId.parse(spec.router) if spec.router else None,
        is_client=spec.is_client,
    )


def to_endpoint(hop: HopSpec) -> Endpoint:
    """Return transport and address of a hop; each uplink is a transport of its own.

    Raises:
        ValueError: the address is not that of one station, or does not fit the transport.
    """
    if hop.kind in {TransportKind.AMS_TCP, TransportKind.AMS_TLS}:
        # A transport for each peer, because each has a connection and a state of its own.
        return Endpoint(f"{hop.kind}:{hop.address}", hop.address)
    address = hop.address
    if hop.kind in _ADDRESSES:
        where = Destination.parse(address)
        if where.kind not in _ADDRESSES[hop.kind] or where.is_group:
            raise ValueError(f"{address!r} is not an address of one station by {hop.kind}")
        address = where.host
        if where.kind is DestinationKind.IP:
            address += f":{where.port or EAP_PORT}"
    return Endpoint(f"{hop.kind}:{hop.port}", address)


def access_of(station: StationSpec, routing: RoutingSpec) -> AccessList:
    """Return the access rules of a station; first those that close unidirectional networks."""
    # The first matching rule decides: no rule of the plant file can open such a network.
    closed = tuple(
        AccessRule(
            f"unidirectional of {spec.network}",
            allow=False,
            transports=(mqtt_transport_name(spec),),
        )
        for spec in routing.mqtt
        if spec.is_unidirectional
    )
    return AccessList((*closed, *routing.access), own=tuple(_own_addresses(station)))


_WITH_ROLES = frozenset((TransportKind.WEB, TransportKind.OPCUA))


def denial_of_write(router: StationRouter, origin: WriteOrigin) -> str:
    """Return the reason that a user of the page or a bridge may not write variables.

    Page and OPC UA server have checked the user's role.  So without a rule it may write, also from
    another host, whose programs may not: they have no user.

    Returns:
        The rule, or the default, in words; empty if it may.
    """
    return _denial_of(router, origin, Write(IndexGroup.VALUE_BY_HANDLE, 0, b""))


def denial_of_control(router: StationRouter, origin: WriteOrigin) -> str:
    """Return likewise the reason that such a user may not change the state of a station."""
    return _denial_of(router, origin, WriteControl(0, 0, b""))


def _denial_of(router: StationRouter, origin: WriteOrigin, operation: Operation) -> str:
    # These clients have no NetID, and their addresses no port that would tell anything.
    endpoint = Endpoint(TransportKind(origin.transport), origin.host)
    role = origin.role
    grants = router.access.grants(endpoint, NetId(b""), router.net_id, IO_PORT, role)
    decision = grants.decide(operation)
    is_by_role = endpoint.kind in _WITH_ROLES and not decision.is_by_rule
    return "" if decision.is_allowed or is_by_role else decision.why


def mqtt_transport_name(spec: MqttSpec) -> str:
    """Return the name of the transport of a network."""
    return f"{TransportKind.MQTT}:{spec.network}"


def _own_addresses(station: StationSpec) -> Iterator[IPv4Address]:
    for port in station.ports:
        uri = port.interface
        if uri.scheme not in _IP_SCHEMES:
            continue
        address = IPv4Address(uri.host)
        if address.is_unspecified:
            yield from (IPv4Address(own) for _, own in own_addresses())
        else:
            yield address


MAX_ADDED = 1000
"""Limit of the routes that can be added to one station."""
MAX_NAME = 80
LEARNED_NS = 600_000_000_000
"""Lifetime of a learned route, unless its router answers again."""

logger = logging.getLogger(__name__)


class StationRoutes:
    """Routes of the router of a station.

    Args:
        router: Router of the station.
        spec: Routing configuration of the plant file.
        store: Stores the added routes.
        open_hop: Returns the endpoint of a hop; raises ValueError if there is no such transport.

    Attributes:
        router: Router of the station.
        scanners: Send requests to routers of other hosts, one for each address of the station.
        on_spec: Called after another configuration is in force.
    """

    def __init__(
        self,
        router: StationRouter,
        spec: RoutingSpec,
        store: StationFile[tuple[RouteSpec, ...]],
        *,
        open_hop: Callable[[HopSpec], Endpoint] = to_endpoint,
    ) -> None:
        self.router = router
        self.scanners: list[RouterRequests] = []
        self.on_spec: list[Callable[[], None]] = []
        self._spec = spec
        self._store = store
        self._open_hop = open_hop
        self._added: dict[RouteSpec, bool] = {}
        """With whether it is stored."""
        self._configured: dict[tuple[NetId, Endpoint], RouteSpec] = {}
        self._jobs = JobQueue("routes")

    @property
    def spec(self) -> RoutingSpec:
        """Routing configuration in force."""
        return self._spec

    @property
    def added(self) -> tuple[RouteSpec, ...]:
        """The added routes, the oldest first."""
        return tuple(self._added)

    def start(self, spec: RoutingSpec | None = None) -> None:
        """Add the routes of the plant file, or of *spec*, then those that were added before."""
        self._spec = spec or self._spec
        self._apply_spec()
        for added in self._store.read() or ():
            self._add_to_table(added)
            self._added[added] = True  # it may be possible after the next start

    def replace_spec(self, spec: RoutingSpec) -> None:
        """Apply another configuration; added and learned routes stay."""
        self._spec = spec
        self._apply_spec()
        for each in self._added:  # a configured route of the same hop may have hidden one of them
            self._add_to_table(each)
        for notify in self.on_spec:
            notify()

    def secure_settings(self, hop: Endpoint) -> SecureRouteSpec:
        """Return the settings of the route that leads to *hop* by Secure ADS, complete."""
        for spec in (*self._configured.values(), *self._added):
            if spec.tls is not None and to_endpoint(spec.hop) == hop:
                return spec.tls.complete(self._spec.secure)
        return SecureRouteSpec()

    def secure_clients(self) -> dict[str, str]:
        """Return the names of clients by Secure ADS by the fingerprints that they are known by."""
        secure = self._spec.secure
        known = {
            spec.tls.fingerprint: spec.name
            for spec in (*self._added, *self._configured.values())
            if spec.tls is not None and spec.tls.fingerprint and not spec.is_unidirectional
        }
        peers = () if secure is None else secure.peers
        return known | {each.fingerprint: each.name for each in peers}

    def is_derived(self, route: Route) -> bool:
        """Return whether a route follows from the ports of the plant."""
        spec = self._configured.get(route.key)
        return spec is not None and spec.is_derived

    def has(self, prefix: bytes) -> bool:
        """Return whether a NetID of the station itself begins with *prefix*."""
        return any(own.startswith(prefix) for own in self.router.net_ids)

    def check(self, spec: RouteSpec) -> None:
        """Raise ControlError with the reason if a route cannot be added."""
        self._validated(spec, "")

    async def add(self, spec: RouteSpec, *, replaces: str = "", is_kept: bool = True) -> Route:
        """Add a route; it replaces added ones with its name or NetID.

        Args:
            spec: The route.
            replaces: Name or NetID of another one that it replaces.
            is_kept: Whether it is stored over restarts.

        Raises:
            ControlError: the route is impossible, a configured route has precedence, or too many
                changes wait already.
            EnvironmentalError: it cannot be stored.
        """
        return await self._jobs.run(partial(self._add, spec, replaces, is_kept=is_kept))

    def learn(self, net_id: NetId, name: str, address: str, now_ns: int) -> bool:
        """Learn a route by AMS/TCP to a router that answered; return whether it was accepted.

        It expires after ten minutes, and configured or added routes have precedence.
        """
        found = self.router.table.find(net_id)
        # A NetID proves nothing: an answer must not redirect packets of this station.
        if not self._spec.learns_from(address) or self.has(net_id.station):
            return False
        if found is not None:
            known, octets = found
            if octets >= STATION_OCTETS and known.origin is not Origin.LEARNED:
                return False
        hop = to_endpoint(HopSpec(TransportKind.AMS_TCP, "", f"{address}:{AMS_TCP_PORT}"))
        route = Route(
            net_id,
            _plain(name) or address,
            hop,
            Origin.LEARNED,
            expires_at_ns=now_ns + LEARNED_NS,
            # A router without a route back does not answer probes, and would be marked as down.
            is_probed=False,
        )
        return self.router.add_route(route)

    async def remove(self, text: str, *, transport: str = "", address: str = "") -> RouteSpec:
        """Remove an added route by its name or NetID, and return it.

        *transport* and *address* select one of several.

        Raises:
            ControlError: no such route was added, or too many changes wait already.
            EnvironmentalError: the change cannot be stored.
        """
        return await self._jobs.run(partial(self._remove, text, transport, address))

    async def _add(self, spec: RouteSpec, replaces: str, *, is_kept: bool) -> Route:
        spec, old = self._validated(spec, replaces)
        route = self._route(spec, Origin.ADDED)
        if route.key in self._configured:
            raise ControlError(_hidden_by(self._configured[route.key].name))
        left = {each: kept for each, kept in self._added.items() if each not in old}
        await self._change({**left, spec: is_kept}, gone=old)
        self.router.add_route(route)
        return route

    async def _remove(self, text: str, transport: str, address: str) -> RouteSpec:
        found = [
            spec
            for spec in self._added
            if text in _names(spec) and self._is_at(spec, transport, address)
        ]
        if not found:
            raise ControlError(self._why_not_removed(text))
        left = {each: kept for each, kept in self._added.items() if each != found[0]}
        await self._change(left, gone=found[:1])
        return found[0]

    def _validated(self, spec: RouteSpec, replaces: str) -> tuple[RouteSpec, list[RouteSpec]]:
        """Return a route as it is stored, and the added ones that it replaces."""
        spec = replace(spec, name=_plain(spec.name), is_derived=False)
        known_as = {spec.name, spec.virtual or spec.net_id, replaces} - {""}
        old = [each for each in self._added if _names(each) & known_as]
        self._check(spec, len(self._added) - len(old))
        return spec, old

    async def _change(self, added: dict[RouteSpec, bool], gone: Sequence[RouteSpec]) -> None:
        kept = tuple(each for each, is_kept in added.items() if is_kept)
        # Stored before it is in force: after a power failure the answer to the client stays true.
        await asyncio.to_thread(self._store.save, kept)
        self._added = added
        for each in gone:
            self._remove_from_table(each)

    def _apply_spec(self) -> None:
        """Apply the routes of the configuration; unchanged ones stay as they are.

        A connection to a next hop is closed when its last route is removed.
        """
        before, self._configured = self._configured, {}
        for spec in self._spec.routes:
            try:
                route = self._route(spec, Origin.STATIC)
            except ControlError as exc:
                logger.warning("route %s of the plant file ignored: %s", spec.name, exc)
                continue
            self._configured[route.key] = spec
            # Adding a route again would close the connection to its hop and drop pending requests.
            if before.get(route.key) != spec:
                self.router.add_route(route)
        for key in before.keys() - self._configured.keys():
            self.router.remove_route(*key)

    def _add_to_table(self, spec: RouteSpec) -> None:
        """Put an added route in force."""
        try:
            self.router.add_route(self._route(spec, Origin.ADDED))
        except ControlError as exc:
            logger.warning("added route %s ignored: %s", spec.name, exc)

    def _route(self, spec: RouteSpec, origin: Origin) -> Route:
        try:
            return to_route(spec, self._open_hop(spec.hop), origin)
        except ValueError as exc:
            raise ControlError(f"route {spec.name!r}: {exc}") from None

    def _remove_from_table(self, spec: RouteSpec) -> None:
        """Remove an added route from the table, unless a configured one has replaced it there."""
        for route in list(self.router.table):
            same = route.origin is Origin.ADDED and route.name == spec.name
            if same and str(route.net_id) == (spec.virtual or spec.net_id):
                self.router.remove_route(*route.key)

    def _check(self, spec: RouteSpec, others: int) -> None:
        if others >= MAX_ADDED:
            raise ControlError(f"{MAX_ADDED} routes were added already; remove some")
        if not spec.name:
            raise ControlError("a route needs a name")
        try:
            net_id = NetId.parse(spec.virtual or spec.net_id)
        except ValueError as exc:
            raise ControlError(f"route {spec.name!r}: {exc}") from None
        if not any(net_id) and spec.octets:
            raise ControlError(f"NetID {net_id} is the default route; it matches 0 octets")
        prefix = net_id[: spec.octets]
        if spec.octets and self.has(prefix):
            raise ControlError(f"NetID {prefix_text(prefix)} belongs to this station")
        for route in self.router.table:
            if route.origin is Origin.STATIC and _covers(route, net_id, spec.octets):
                raise ControlError(_hidden_by(route.name))

    def _is_at(self, spec: RouteSpec, transport: str, address: str) -> bool:
        if not transport and not address:
            return True
        hop = self._open_hop(spec.hop)
        return transport in {"", hop.transport} and address in {"", hop.connection}

    def _why_not_removed(self, text: str) -> str:
        for route in self.router.table:
            if text in {route.name, str(route.net_id)}:
                if route.origin is Origin.STATIC:
                    where = "follows from the ports in" if self.is_derived(route) else "is in"
                    return f"route {route.name!r} {where} the plant file; change it there"
                if route.origin is Origin.LEARNED:
                    return (
                        f"route {route.name!r} is learned: it expires; 'learn: false' prevents it"
                    )
        names = ", ".join(spec.name for spec in self._added) or "none"
        return f"no route {text!r} was added; added routes: {names}"


def _covers(route: Route, net_id: NetId, octets: int) -> bool:
    """Return whether a configured route covers all NetIDs of another one."""
    if not octets:
        return not route.octets
    return 0 < route.octets <= octets and net_id.startswith(route.net_id[: route.octets])


def _hidden_by(name: str) -> str:
    return (
        f"route {name!r} of the plant file covers the same NetIDs and has precedence; change the"
        " plant file"
    )


def _names(spec: RouteSpec) -> set[str]:
    return {spec.name, spec.virtual or spec.net_id}


def _plain(name: str) -> str:
    return "".join(filter(str.isprintable, name)).strip()[:MAX_NAME]
