"""From a plant file without findings to what the routers of its stations are told."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from eap.aoe.spec import (
    AmsUser,
    DirectoryPort,
    DirectoryStation,
    DoorKind,
    HopSpec,
    RouteSpec,
    RoutingSpec,
)
from eap.config.brokers import broker_spec, brokers_of, shared_network
from eap.config.index import Index
from eap.config.learning import learn_sources
from eap.config.neighbours import find_hop
from eap.config.reach import net_ids_of, reach, without_prefix
from eap.config.routes import next_hop
from eap.config.rules import access_rules
from eap.config.structs import Station
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import PortKind


def derive_routing(index: Index, folder: Path) -> dict[str, RoutingSpec]:
    """Return by its name what the router of each station is told; files are in *folder*."""
    loose = without_prefix(index)
    known = {each.name: net_ids_of(each, loose) for each in index.plant.stations}
    return {
        station.name: RoutingSpec(
            routes=(*_written(index, station, loose), *_derived(index, station, known)),
            mqtt=tuple(broker_spec(each, folder) for each in brokers_of(station)),
            access=tuple(access_rules(index, station, loose)),
            users=tuple(
                AmsUser(user.name, str((folder / user.password_file).resolve()))
                for user in station.users
            ),
            learn=learn_sources(station),
        )
        for station in index.plant.stations
    }


def derive_directory(index: Index) -> tuple[DirectoryStation, ...]:
    """Return the names of everything in the plant."""
    return tuple(
        DirectoryStation(
            name=station.name,
            net_id=str(NetId.parse(station.net_id)),
            ports=tuple(
                DirectoryPort(
                    name=port.name,
                    is_bus=port.kind is PortKind.BUS,
                    net_id=str(NetId.parse(port.net_id)),
                    interface=str(InterfaceUri.parse(port.interface)),
                    slaves=_slaves(index, station, port.name),
                )
                for port in station.ports
            ),
        )
        for station in index.plant.stations
    )


def _slaves(index: Index, station: Station, port: str) -> dict[str, int]:
    bus = index.buses.get((station.name, port))
    return {slave.name: slave.station for slave in bus.slaves} if bus else {}


def _written(index: Index, station: Station, loose: set[str]) -> Iterator[RouteSpec]:
    for route in station.routes:
        if route.mqtt:
            continue
        hop, router = next_hop(index, station, route)
        for net_id, octets in reach(index, route, loose):
            yield RouteSpec(
                name=route.to,
                net_id=net_id,
                hop=hop,
                octets=octets,
                router=router,
                virtual=str(NetId.parse(route.virtual)) if route.virtual else "",
                is_unidirectional=route.unidirectional,
                timeout_ms=route.timeout_ms,
                is_probed=route.probe,
            )


def _derived(
    index: Index, station: Station, known: dict[str, list[tuple[str, int]]]
) -> Iterator[RouteSpec]:
    """Yield routes to the stations that share an interface or a broker with *station*.

    *known* has NetIDs and octets to match for each station; its router's come first.
    """
    written = {route.to for route in station.routes}
    for target in index.plant.stations:
        if target is station or target.name in written:
            continue
        router = known[target.name][0][0]
        hop = find_hop(index, station, target)
        network = "" if hop else shared_network(station, target)
        if network:
            hop = HopSpec(DoorKind.MQTT, network, router)
        if hop is None:
            continue
        for net_id, octets in known[target.name]:
            yield RouteSpec(
                name=target.name,
                net_id=net_id,
                hop=hop,
                octets=octets,
                router=router,
                # The broker tells who is there; all asking all each second is a load of its own.
                is_probed=hop.kind is not DoorKind.MQTT,
                is_derived=True,
            )
