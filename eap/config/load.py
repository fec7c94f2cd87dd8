"""Loading of a plant file, or of a plant without one: specifications, or findings.

The specifications are derived after all checks have passed, so that nothing fails there.  Values
that the file leaves open are computed: writers, phases, addresses, groups to join, and the facts
about a sender that a subscriber needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from hashlib import blake2b
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from eap.ams.spec import (
    AmsUser,
    DirectoryPort,
    DirectoryStation,
    HopSpec,
    RouteSpec,
    RoutingSpec,
    TransportKind,
)
from eap.codec import datatypes
from eap.codec.datatypes import variable_of
from eap.codec.structures import complete
from eap.config.access import access_rules, check_access
from eap.config.brokers import (
    broker_spec,
    brokers_of,
    check_discovery,
    discovery_sources,
    shared_network,
    warn_of_open_brokers,
)
from eap.config.bus import (
    DescribeBus,
    bus_file,
    check_gateways,
    describe_buses,
    gateway_spec,
    locked_port,
)
from eap.config.document import convert, read, read_net_id
from eap.config.eoe import check_eoe, eoe_spec
from eap.config.exchange import check_polls, check_publish, check_subscribe
from eap.config.exposure import Exposure, find_exposures
from eap.config.field import check_field, field_bridge_on, field_bridges, resolved_source
from eap.config.files import whole_path
from eap.config.finding import FindingReport, PlantFinding
from eap.config.hosts import check_hosts, is_served_on
from eap.config.index import Index, SentPd, VariablePart
from eap.config.links import check_links, ends, execution_order, is_bitwise
from eap.config.mqtt import check_mqtt, mqtt_spec, warn_of_commands
from eap.config.opcua import check_opcua, resolved_opcua, warn_of_open_channels
from eap.config.opcua_sections import OpcUaSection
from eap.config.pd_keys import check_key_files
from eap.config.phases import derive_phases
from eap.config.plant_sections import HostSection, PlantFile
from eap.config.plant_users import check_plant_users, with_shared_users
from eap.config.ports import IP_BROADCAST, check_ports, find_net_id, group_of, resolve_destination
from eap.config.record import check_recordings, records_of, resolved_recordings
from eap.config.record_sections import RecordSection
from eap.config.routes import (
    check_routes,
    find_hop,
    follow_routes,
    net_ids_of,
    next_hop,
    route_net_ids,
    stations_without_prefix,
)
from eap.config.secure import check_secure_ads, secure_ads_spec, secure_route_spec
from eap.config.servers import check_servers
from eap.config.structs import (
    ANY_SOURCE,
    AuditMode,
    FrameSection,
    FromSection,
    PortSection,
    StationSection,
    SubscribeSection,
    VariableSection,
)
from eap.config.types import TypeTable, resolve_types
from eap.config.users import PlantUserSection
from eap.config.variables import check_variables
from eap.config.web import check_web, resolved, resolved_tls, warn_of_pictures
from eap.config.web_sections import MetricsSection, WebSection
from eap.ids import Destination, InterfaceUri, MacAddr, NetId, encode_value
from eap.pd.address import address_text, net_id_of, source_octets
from eap.pd.spec import (
    REQUESTER,
    BusPortSpec,
    CsvSource,
    LinkSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    ServicesSource,
    Source,
    StationSpec,
    TxFrameSpec,
    VariableSpec,
    Writer,
)


def derive(index: Index, folder: Path) -> tuple[StationSpec, ...]:
    """Return the specification of every station; files are relative to *folder*."""
    return tuple(
        _station(index, station, phase_us, folder)
        for station, phase_us in zip(index.plant.stations, derive_phases(index), strict=True)
    )


def _station(index: Index, station: StationSection, phase_us: int, folder: Path) -> StationSpec:
    return StationSpec(
        name=station.name,
        net_id=station.net_id,
        cycle_us=index.cycle_us(station),
        ports=tuple(
            _bus_port(index, station, port, folder)
            if port.kind is PortKind.BUS
            else _port(index, station, port)
            for port in station.ports
        ),
        phase_us=phase_us,
        variables=tuple(_variables(index, station)),
        sources=tuple(_source(index, source, folder) for source in station.sources.values()),
        targets=tuple(station.targets.values()),
        frames=tuple(_frames(index, station)),
        subscriptions=tuple(_subscription(index, each) for each in station.subscribe),
        links=tuple(_links(index, station)),
        pd_keys=whole_path(folder, index.pd_keys(station)),
    )


def _variables(index: Index, station: StationSection) -> Iterator[VariableSpec]:
    names = index.names(station)
    linked = {variable_of(link.target, names) for link in station.links}
    # All sources within one variable are of the engine, or all of services.
    sources = {variable_of(name, names): each for name, each in station.sources.items()}
    for name, variable in station.variables.items():
        source = sources.get(name)
        writer = Writer.ENGINE if source is not None or name in linked else Writer.APPLICATION
        if isinstance(source, ServicesSource):
            writer = Writer.SERVICES
        yield _variable(name, variable, writer)
    for subscription in station.subscribe:
        if subscription.variables is not None:
            for name, variable in subscription.variables.items():
                yield _variable(name, variable, Writer.ENGINE)
        else:
            sent = index.publishers(subscription)[0]
            for name, text in index.received(subscription).items():
                original = sent.station.variables.get(name.removeprefix(f"{subscription.name}."))
                unit, comment = (original.unit, original.comment) if original else ("", "")
                copy = VariableSection(type=text, unit=unit, comment=comment)
                yield _variable(name, copy, Writer.ENGINE)
    for name, (text, unit, comment) in index.field_variables(station).items():
        yield VariableSpec(name, text, Writer.SERVICES, unit=unit, comment=comment)
    for name, on_bus in index.bus_variables(station).items():
        is_free = on_bus.is_output and name not in linked
        # Inputs come from the bus, and a link writes its target: only a free output is left to
        # programs.
        writer = Writer.APPLICATION if is_free else Writer.ENGINE
        yield VariableSpec(name, on_bus.type, writer, comment=on_bus.comment)


def _links(index: Index, station: StationSection) -> Iterator[LinkSpec]:
    """Yield the links in execution order: each after those that write its source."""
    spans = [
        ends(link, _part(index, station, link.source), _part(index, station, link.target))
        for link in station.links
    ]
    for position in execution_order(spans):
        link, span = station.links[position], spans[position]
        yield LinkSpec(
            source=link.source,
            target=link.target,
            source_bit=link.from_bit or 0,
            target_bit=link.to_bit or 0,
            bits=span.source.bits if is_bitwise(link) else 0,
            scale=1.0 if link.scale is None else link.scale,
            offset=link.offset or 0.0,
            swap=link.swap,
        )


def _part(index: Index, station: StationSection, name: str) -> VariablePart:
    part = index.part(station, name)
    if part is None:  # the checks report it
        raise LookupError(name)
    return part


def _variable(name: str, variable: VariableSection, writer: Writer) -> VariableSpec:
    kind = datatypes.parse(variable.type)
    # Converted to the type and back, so that reading a dictionary returns the same value.
    default: Any = None
    if variable.default is not None:
        default = kind.to_plain(kind.from_plain(complete(kind, variable.default)))
    return VariableSpec(
        name=name,
        type=kind.text,
        writer=writer,
        default=default,
        unit=variable.unit,
        comment=variable.comment,
    )


def _source(index: Index, source: Source, folder: Path) -> Source:
    # Relative to the plant file, and not to the working directory of services.
    if isinstance(source, CsvSource):
        return msgspec.structs.replace(source, file=whole_path(folder, source.file))
    return resolved_source(index, source)


def _frames(index: Index, station: StationSection) -> Iterator[TxFrameSpec]:
    for frame in station.frames:
        destination = _destination(index, station, frame)
        pds = tuple(pd.spec() for pd in station.publish if pd.frame == frame.name)
        yield frame.spec(destination, pds, _mac(index, destination))


def _destination(index: Index, station: StationSection, frame: FrameSection) -> str:
    if frame.to == REQUESTER:
        return REQUESTER
    return str(resolve_destination(frame.to, index.uris[station.name, frame.port], index))


def _mac(index: Index, destination: str) -> str:
    """Return the MAC address that the plant gives for a NetID, empty if there is none."""
    net_id = net_id_of(destination)
    if net_id is None:
        return ""
    text = "".join(index.ports[key].mac for key in find_net_id(str(net_id), index))
    return str(MacAddr.parse(text)) if text else ""


def _subscription(index: Index, subscription: SubscribeSection) -> RxPdSpec:
    source, publishers = subscription.source, index.publishers(subscription)
    if publishers:
        sent = publishers[0]
        pd_id, version = sent.pd.id, sent.pd.version
        publisher = str(sent.port.net_id)
        step, sender_cycle_us = _common_step(index, publishers)
    if isinstance(source, FromSection):
        pd_id = source.id
        publisher = "" if source.publisher == "any" else str(NetId.parse(source.publisher))
        if not publishers:
            version, step, sender_cycle_us = 0, source.step or 0, source.cycle_us or 0
    return RxPdSpec(
        name=subscription.name,
        port=subscription.port,
        pd_id=pd_id,
        variables=tuple(index.received(subscription)),
        publisher=publisher,
        version=version if subscription.version is None else subscription.version,
        ignore_version=subscription.ignore_version,
        timeout_ms=subscription.timeout_ms,
        substitute=subscription.substitute,
        sender_cycle_us=sender_cycle_us,
        step=step,
        poll_request=subscription.poll,
        changeable=subscription.changeable,
        source=_sender_address(index, subscription, publishers),
        auth=subscription.auth,
    )


def _sender_address(index: Index, subscription: SubscribeSection, publishers: list[SentPd]) -> str:
    """Return the source address of the frames of *publishers*, empty for any.

    The plant knows it where the publisher's port has an address of its own: the IPv4 address of a
    UDP or TCP port, the ``mac`` of an Ethernet port.
    """
    if subscription.sender:
        is_any = subscription.sender == ANY_SOURCE
        return "" if is_any else address_text(source_octets(subscription.sender))
    # Several publishers with different addresses: any of them may send.
    known = {_own_address(index, sent) for sent in publishers}
    return known.pop() if len(known) == 1 else ""


def _own_address(index: Index, sent: SentPd) -> str:
    uri = index.uris[sent.station.name, sent.port.name]
    if uri.scheme in {"udp", "tcp"}:
        return "" if IPv4Address(uri.host).is_unspecified else uri.host
    return str(MacAddr.parse(sent.port.mac)) if sent.port.mac else ""


def _common_step(index: Index, publishers: list[SentPd]) -> tuple[int, int]:
    """Return step and device cycle of *publishers*, 0 if theirs differ."""
    steps = {index.step(sent) for sent in publishers}
    cycles = {index.cycle_us(sent.station) for sent in publishers}
    return steps.pop() if len(steps) == 1 else 0, cycles.pop() if len(cycles) == 1 else 0


def _port(index: Index, station: StationSection, port: PortSection) -> PortSpec:
    destinations = list(_received_destinations(index, station, port))
    groups = [_group(text) for text in port.join]
    groups += [group for each in destinations if (group := group_of(each)) is not None]
    return PortSpec(
        name=port.name,
        kind=port.kind,
        interface=index.interface(station.name, port.name),
        net_id=port.net_id,
        vlan_id=port.vlan_id,
        vlan_priority=port.vlan.priority if port.vlan else 0,
        join=tuple(dict.fromkeys(groups)),
        broadcast=port.broadcast or any(each.host == IP_BROADCAST for each in destinations),
        tcp=port.tcp,
        wake=port.wake,
        eap_sm=port.eap_sm,
        length=port.length,
        profile=port.profile,
        ams=port.ams,
    )


def _bus_port(index: Index, station: StationSection, port: PortSection, folder: Path) -> PortSpec:
    uri = index.interface(station.name, port.name)
    file = bus_file(port, folder)[1]
    path = "" if file is None else str(file.resolve())
    bus = index.buses[station.name, port.name]
    return PortSpec(
        name=port.name,
        kind=port.kind,
        interface=InterfaceUri("sim", path) if uri.scheme == "sim" else uri,
        net_id=port.net_id,
        bus=BusPortSpec(
            path,
            bus.slaves,
            port.target,
            port.clocks,
            port.frame_timeout_us,
            port.frame_retries,
            _second_line(index, station, port),
            locked_port(index, station) == port.name,
            port.sync_lead_us,
            bus.digest if uri.scheme == "sim" else "",
        ),
        gateway=gateway_spec(index, station, port),
        eoe=eoe_spec(port),
    )


def _second_line(index: Index, station: StationSection, port: PortSection) -> str:
    if not port.redundant:
        return ""
    return str(index.interface_on_host(station.name, InterfaceUri.parse(port.redundant)))


def _group(text: str) -> str:
    return str(MacAddr.parse(text)) if len(text) == len("01:01:05:04:00:00") else text


def _received_destinations(
    index: Index, station: StationSection, port: PortSection
) -> Iterator[Destination]:
    """Yield the destinations of the frames that *port* subscribes to."""
    for subscription in station.subscribe:
        if subscription.port == port.name:
            for sent in index.publishers(subscription):
                # An answer is unicast to its requester: no group has to be joined for it.
                if sent.frame.to == REQUESTER:
                    continue
                uri = index.uris[sent.station.name, sent.port.name]
                yield resolve_destination(sent.frame.to, uri, index)


def derive_routing(index: Index, folder: Path) -> dict[str, RoutingSpec]:
    """Return the routing of each station by its name; files are in *folder*."""
    shared = stations_without_prefix(index)
    known = {each.name: net_ids_of(each, shared) for each in index.plant.stations}
    return {
        station.name: RoutingSpec(
            routes=(
                *_configured_routes(index, station, shared, folder),
                *_derived_routes(index, station, known),
            ),
            mqtt=tuple(broker_spec(each, folder) for each in brokers_of(station)),
            access=tuple(access_rules(index, station, shared)),
            users=tuple(
                AmsUser(user.name, whole_path(folder, user.password_file)) for user in station.users
            ),
            learn=discovery_sources(station),
            secure=secure_ads_spec(station.secure_ads, folder),
        )
        for station in index.plant.stations
    }


def derive_directory(index: Index) -> tuple[DirectoryStation, ...]:
    """Return the names of the stations, ports and slaves of the plant."""
    return tuple(
        DirectoryStation(
            name=station.name,
            net_id=station.net_id,
            ports=tuple(
                DirectoryPort(
                    name=port.name,
                    is_bus=port.kind is PortKind.BUS,
                    net_id=port.net_id,
                    interface=index.interface(station.name, port.name),
                    slaves={
                        slave.name: slave.station for slave in index.slaves(station, port.name)
                    },
                )
                for port in station.ports
            ),
        )
        for station in index.plant.stations
    )


def _configured_routes(
    index: Index, station: StationSection, shared: set[str], folder: Path
) -> Iterator[RouteSpec]:
    for route in station.routes:
        if route.mqtt:
            continue
        hop, router = next_hop(index, station, route)
        for net_id, octets in route_net_ids(index, route, shared):
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
                tls=secure_route_spec(route.tls, folder),
            )


def _derived_routes(
    index: Index, station: StationSection, known: dict[str, list[tuple[str, int]]]
) -> Iterator[RouteSpec]:
    """Yield routes to the stations that share an interface or a broker with *station*.

    *known* has NetIDs and octets to match for each station; its router's come first.
    """
    written = {route.to for route in station.routes}
    for target in index.plant.stations:
        # A route in the file replaces the derived one of the same station.
        if target is station or target.name in written:
            continue
        router = known[target.name][0][0]
        hop = find_hop(index, station, target)
        network = "" if hop else shared_network(station, target)
        if network:
            hop = HopSpec(TransportKind.MQTT, network, router)
        if hop is None:
            continue
        for net_id, octets in known[target.name]:
            yield RouteSpec(
                name=target.name,
                net_id=net_id,
                hop=hop,
                octets=octets,
                router=router,
                # The broker announces who is connected; probing each pair of stations adds load.
                is_probed=hop.kind is not TransportKind.MQTT,
                is_derived=True,
            )


class Plant(msgspec.Struct, frozen=True):
    """A checked plant, complete."""

    name: str
    stations: tuple[StationSpec, ...]
    routing: Mapping[str, RoutingSpec] = {}
    """Specification of the router of each station, by its name."""
    directory: tuple[DirectoryStation, ...] = ()
    """Names of the stations, ports and slaves of the plant."""
    audit_required: bool = False
    """True if changes that cannot be recorded are refused."""
    users: tuple[PlantUserSection, ...] = ()
    """Users of all stations and servers; empty if programs of this host may do everything."""
    operators: tuple[str, ...] = ()
    """Patterns of the variables that operators set by the control socket."""
    hosts: tuple[HostSection, ...] = ()
    """Computers that run the stations; empty for a plant of one."""
    spins: bool = False
    """True if the engine polls instead of sleeping between two cycles."""
    web: WebSection | None = None
    """Page for browsers, with resolved paths; None without one."""
    metrics: MetricsSection | None = None
    """Metrics without a page, with resolved paths; None without them."""
    record: tuple[RecordSection, ...] = ()
    """Recordings that run beside the plant, with resolved paths."""
    bridges: Mapping[str, msgspec.Struct] = {}
    """Sections of the bridges, by their keys, with resolved paths."""

    def section_digests(self) -> dict[str, str]:
        """Return a digest of each section for an optional process, by its key.

        These begin with the appliance: another digest is another section than the one that runs.
        """
        sections: dict[str, object] = {"web": self.web, "metrics": self.metrics, **self.bridges}
        sections["record"] = self.record or None
        encoded = {
            key: msgspec.json.encode(each, enc_hook=encode_value)
            for key, each in sections.items()
            if each is not None
        }
        return {key: blake2b(each, digest_size=8).hexdigest() for key, each in encoded.items()}

    def on_host(self, host: HostSection) -> Plant:
        """Return the part of the plant that *host* runs: its stations, and the servers it has."""
        web, metrics = self.web, self.metrics
        return replace(
            self,
            stations=tuple(each for each in self.stations if each.name in host.stations),
            web=web if web is None or is_served_on(host, web.listen) else None,
            metrics=metrics if metrics is None or is_served_on(host, metrics.listen) else None,
            record=tuple(each for each in self.record if records_of(each, host.stations)),
            bridges={
                key: field_bridge_on(each, partial(is_served_on, host))
                for key, each in self.bridges.items()
                if not isinstance(each, OpcUaSection) or is_served_on(host, each.listen)
            },
        )


def _bridges(index: Index, folder: Path) -> dict[str, msgspec.Struct]:
    """Return the sections of the bridges of a plant without findings, by their keys."""
    found: dict[str, msgspec.Struct] = {}
    if (mqtt := index.plant.mqtt) is not None:
        found[mqtt.KEY] = mqtt_spec(index, mqtt, folder)
    if (opcua := index.plant.opcua) is not None:
        found[opcua.KEY] = resolved_opcua(opcua, folder, index.plant.access.operators)
    return found | field_bridges(index)


class PlantResult(msgspec.Struct, frozen=True):
    """Either a plant and no findings, or no plant and all findings in the order of the file."""

    plant: Plant | None
    findings: tuple[PlantFinding, ...]
    lines: Mapping[str, int] = {}
    """Line of each path of the file of a valid plant."""
    warnings: tuple[PlantFinding, ...] = ()
    """Warnings about a plant that is valid."""
    types: TypeTable | None = None
    """Types that a valid plant defines."""
    exposures: tuple[Exposure, ...] = ()
    """Places that a valid plant leaves open to other hosts."""


def load(path: Path, describe_bus: DescribeBus, folder: Path | None = None) -> PlantResult:
    """Read, check and complete the plant file at *path*; never raises for the content of the file.

    Args:
        path: The file.
        describe_bus: Reads the bus files that it names; their findings follow those of the plant.
        folder: Folder of the plant file where the plant runs, to which specifications refer; by
            default that of *path*.
    """
    report = FindingReport(str(path))
    root = read(path, report)
    plant_file = None if root is None else convert(root, report)
    if plant_file is None:
        return PlantResult(None, report.findings())
    report.stations |= {station.name for station in plant_file.stations}
    plant_file = with_shared_users(plant_file)
    plant_file, types = resolve_types(plant_file, report, path.parent)
    index = Index(plant_file, describe_buses(plant_file, path.parent, describe_bus, report))
    check_ports(index, report)
    check_gateways(index, report)
    check_eoe(index, report)
    check_variables(index, report, path.parent)
    check_publish(index, report)
    check_subscribe(index, report)
    check_polls(index, report)
    check_links(index, report)
    check_routes(index, report, path.parent)
    check_discovery(index, report)
    check_secure_ads(index, report, path.parent)
    check_access(index, report, path.parent)
    check_plant_users(index, report)
    check_web(index, report, path.parent)
    check_mqtt(index, report, path.parent)
    check_opcua(index, report, path.parent)
    check_field(index, report)
    check_servers(index, report)
    check_key_files(index, report, path.parent)
    check_hosts(index, report)
    check_recordings(index, report)
    # Derived only from a plant without findings, so nothing below can fail.
    if findings := report.findings():
        return PlantResult(None, findings)
    folder = path.parent if folder is None else folder
    plant = Plant(
        plant_file.plant,
        derive(index, folder),
        derive_routing(index, folder),
        derive_directory(index),
        audit_required=plant_file.access.audit is AuditMode.REQUIRED,
        users=plant_file.users,
        operators=plant_file.access.operators,
        hosts=plant_file.hosts,
        spins=plant_file.realtime.spin,
        web=plant_file.web and resolved(plant_file.web, path.parent),
        metrics=plant_file.metrics and resolved_tls(plant_file.metrics, path.parent),
        record=resolved_recordings(plant_file.record, path.parent),
        bridges=_bridges(index, path.parent),
    )
    warnings = (
        *report.warnings,
        *follow_routes(index, plant.routing, report),
        *warn_of_open_brokers(index, report),
        *warn_of_pictures(index, report, path.parent),
        *warn_of_commands(index, report),
        *warn_of_open_channels(index, report),
    )
    exposures = find_exposures(index, report, path.parent)
    return PlantResult(plant, (), report.lines, warnings, types, exposures)


PORT = "eap0"
_ROUTER, _PORT = "station", "port"
INTERFACE_PATH = f"{_PORT}.interface"
NET_ID_PATHS = f"{_PORT}.net_id", f"{_ROUTER}.net_id"


def blank(name: str, interface: str, net_id: str, cycle_us: int) -> PlantResult:
    """Return a plant called *name* that has one station of that name.

    A plant file's rules hold, and findings have paths as above.  *net_id* is that of the
    port: publisher ID of its frames and address of its dictionary.  The router of a station has a
    NetID of its own, which here is the port's with its fifth octet one less.

    Args:
        name: Of plant and station.
        interface: Of the port, as in a plant file.
        net_id: Of the port.
        cycle_us: Device cycle.
    """
    report = FindingReport("")
    own = read_net_id(net_id, NET_ID_PATHS[-1], report)
    port = PortSection(at=_PORT, name=PORT, kind=PortKind.EAP, interface=interface, net_id=own)
    station = StationSection(
        at=_ROUTER, name=name, net_id=_router(own), ports=(port,), cycle_us=cycle_us
    )
    index = Index(PlantFile(plant="blank", stations=(station,)))
    check_ports(index, report)
    if findings := report.findings():
        return PlantResult(None, findings)
    plant = Plant(
        name, derive(index, Path()), derive_routing(index, Path()), derive_directory(index)
    )
    return PlantResult(plant, ())


def _router(net_id: NetId) -> NetId:
    if not net_id:
        return net_id
    octets = bytearray(net_id)
    # The fifth octet numbers the devices of a host, as 1.1 and 2.1 in plant files do.
    octets[4] = (octets[4] - 1) & 0xFF
    return NetId(octets)
