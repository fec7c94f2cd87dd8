"""The router of a station, made from what the plant file says of it."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Address

from eap.ads.endpoint import Endpoint
from eap.ams.access import AccessList
from eap.ams.routes import Origin, Route
from eap.ams.spec import AccessRule, HopSpec, MqttSpec, RouteSpec, RoutingSpec, TransportKind
from eap.codec.ethercat import EAP_PORT
from eap.ids import Destination, DestinationKind, InterfaceUri, NetId
from eap.net.interface import own_addresses
from eap.pd.spec import StationSpec
from eap.services.routing.station_router import StationRouter

_IP_SCHEMES = ("udp", "tcp")
_ADDRESSES = {
    TransportKind.UDP: (DestinationKind.IP,),
    TransportKind.TCP: (DestinationKind.IP,),
    TransportKind.ETHERNET: (DestinationKind.MAC, DestinationKind.NET_ID),
}


def make_router(station: StationSpec, routing: RoutingSpec) -> StationRouter:
    """Return the router of a station, without services and routes."""
    net_id = NetId.parse(station.net_id)
    net_ids = [NetId.parse(port.net_id) for port in station.ports]
    return StationRouter(station.name, net_id, net_ids, access=access_of(station, routing))


def to_route(spec: RouteSpec, hop: Endpoint, origin: Origin) -> Route:
    """Return the route that *spec* describes, by *hop*; raise ValueError if there can be none."""
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


def to_way(hop: HopSpec) -> Endpoint:
    """Return door and address of a hop; each AMS/TCP connection to others is a door of its own.

    Raises:
        ValueError: the address is none of one station, or none for this door.
    """
    if hop.kind is TransportKind.AMS_TCP:
        return Endpoint(f"{hop.kind}:{hop.address}", hop.address)
    address = hop.address
    if hop.kind in _ADDRESSES:
        where = Destination.parse(address)
        if where.kind not in _ADDRESSES[hop.kind] or where.is_group:
            raise ValueError(f"{address!r} is no address of a station by {hop.kind}")
        address = where.host
        if where.kind is DestinationKind.IP:
            address += f":{where.port or EAP_PORT}"
    return Endpoint(f"{hop.kind}:{hop.port}", address)


def access_of(station: StationSpec, routing: RoutingSpec) -> AccessList:
    """Return the access rules of a station; first those of networks that may ask nothing."""
    closed = tuple(
        AccessRule(f"unidirectional of {spec.network}", allow=False, transports=(mqtt_door(spec),))
        for spec in routing.mqtt
        if spec.is_unidirectional
    )
    return AccessList((*closed, *routing.access), own=tuple(_own_addresses(station)))


def mqtt_door(spec: MqttSpec) -> str:
    """Return the name of the door to a network."""
    return f"{TransportKind.MQTT}:{spec.network}"


def _own_addresses(station: StationSpec) -> Iterator[IPv4Address]:
    for port in station.ports:
        uri = InterfaceUri.parse(port.interface)
        if uri.scheme not in _IP_SCHEMES:
            continue
        address = IPv4Address(uri.host)
        if address.is_unspecified:
            yield from (IPv4Address(own) for _, own in own_addresses())
        else:
            yield address
