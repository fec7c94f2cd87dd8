"""Hosts of a plant file: which station runs where, checks of the whole plant, and the own host.

A plant without ``hosts`` runs on one host.  With them, a station has the IP addresses of its host,
and what only reaches its own host (loopback addresses, ``loop://`` lines) joins no two hosts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from ipaddress import IPv4Address, IPv4Network

from eap.config.finding import FindingReport, one_of
from eap.config.index import Index, is_local_only
from eap.config.listen import parse_listen
from eap.config.plant_sections import HostSection
from eap.config.ports import check_names, resolve_destination
from eap.config.servers import find_servers
from eap.config.structs import PortSection, StationSection
from eap.errors import ConfigError
from eap.ids import INTERFACE_NAME_SIZE, Destination, DestinationKind, InterfaceUri
from eap.suggest import suggest

ADDRESS = "an IPv4 address or a name of this host, by which the others reach it"
_NETWORK = "an IPv4 address, or a network such as 10.0.0.0/24"
_MOST_NAME = 253
"""Characters of a host name (RFC 1035)."""


def has_address(host: HostSection, address: IPv4Address) -> bool:
    """Return whether *address* is one of *host*."""
    return any(address in network for network in _networks(host))


def _networks(host: HostSection) -> Iterator[IPv4Network]:
    """Yield the addresses of a host as networks; a name and what is malformed is left out."""
    for text in (host.address, *host.addresses):
        try:
            yield IPv4Network(text, strict=False)
        except ValueError:
            continue


def check_hosts(index: Index, report: FindingReport) -> None:
    """Report hosts that cannot be used, and stations, ports and frames that do not fit theirs."""
    hosts = index.plant.hosts
    if not hosts:
        if "hosts" in report.lines:
            report.add("hosts", "the plant has no hosts", "at least one host, or no key hosts")
        return
    check_names(((host.at, host.name) for host in hosts), "host", report)
    _check_placing(index, report)
    _check_addresses(hosts, report)
    for host in hosts:
        _check_interfaces(index, host, report)
    for station in index.plant.stations:
        _check_ports(index, station, report)
    _check_lines(index, report)
    for station in index.plant.stations:
        _check_frames(index, station, report)
        _check_senders(index, station, report)
    _check_servers(index, report)
    _check_bridge_names(index, report)


def _check_placing(index: Index, report: FindingReport) -> None:
    """Report stations that are on no host, on two, or not in the plant."""
    first: dict[str, HostSection] = {}
    for host in index.plant.hosts:
        if not host.stations:
            message = f"host {host.name} runs no station"
            report.add(f"{host.at}.stations", message, "at least one station")
        for position, name in enumerate(host.stations):
            path = f"{host.at}.stations[{position}]"
            if name not in index.stations:
                if name not in report.broken:
                    hint = suggest(name, index.stations)
                    message = f"no station {name!r} in this plant{hint}"
                    report.add(path, message, one_of(index.stations))
            elif name in first:
                other = first[name].name
                report.add(path, f"station {name} runs on {other} already", "one host for each")
            else:
                first[name] = host
    for station in index.plant.stations:
        if station.name not in first:
            message = f"station {station.name} is on no host"
            report.add(f"{station.at}.name", message, "it in stations: of one of the hosts")


def _check_addresses(hosts: Sequence[HostSection], report: FindingReport) -> None:
    """Report malformed addresses, and those that two hosts have."""
    owners: list[tuple[IPv4Network, HostSection]] = []
    for host in hosts:
        paths = [f"{host.at}.address"]
        paths += [f"{host.at}.addresses[{each}]" for each in range(len(host.addresses))]
        for path, text in zip(paths, (host.address, *host.addresses), strict=True):
            is_first = path == paths[0]
            try:
                network = IPv4Network(text, strict=False)
            except ValueError:
                if not (is_first and _is_host_name(text)):
                    expected = ADDRESS if is_first else _NETWORK
                    report.add(path, f"{text!r} is no address of host {host.name}", expected)
                continue
            # Other hosts connect to the first one: it has to be a single address.
            if is_first and "/" in text:
                report.add(path, f"{text!r} is a network", ADDRESS)
                continue
            # Hosts on one computer, as in a trial, share the loopback addresses.
            if network.is_loopback:
                continue
            for other, owner in owners:
                # Two hosts with one address answer for each other, and frames go to either of them.
                if owner is not host and network.overlaps(other):
                    message = f"{text} of host {host.name} is an address of host {owner.name}, too"
                    report.add(path, message, "addresses of its own for each host")
                    break
            owners.append((network, host))


def _is_host_name(text: str) -> bool:
    """Return whether *text* is a host name (RFC 1123); numbers and dots alone are none."""
    labels = text.split(".")
    return (
        len(text) <= _MOST_NAME
        and not labels[-1].isdigit()
        and all(
            label.replace("-", "").isalnum() and label.isascii() and label.strip("-") == label
            for label in labels
        )
    )


def _check_interfaces(index: Index, host: HostSection, report: FindingReport) -> None:
    """Report names of interfaces that no port uses, that cannot be, or that are given twice."""
    used = {
        uri.host
        for name in host.stations
        for (station, _), uri in index.uris.items()
        if station == name and uri.scheme == "ethernet"
    } | {
        port.redundant.removeprefix("ethernet://")
        for (station, _), port in index.ports.items()
        if station in host.stations and port.redundant
    }
    owners: dict[str, str] = {}
    for name in sorted(used | host.interfaces.keys()):
        path = f"{host.at}.interfaces.{name}"
        own = host.interface(name)
        if name not in used:
            message = f"no port of a station on {host.name} is at ethernet://{name}"
            report.add(path, message, one_of(sorted(used)))
        elif not own or len(own) > INTERFACE_NAME_SIZE or "/" in own or " " in own:
            expected = f"a name of at most {INTERFACE_NAME_SIZE} characters"
            report.add(path, f"{own!r} is no interface name", expected)
        elif own in owners:
            path = path if name in host.interfaces else f"{host.at}.interfaces.{owners[own]}"
            message = (
                f"interface {own} of host {host.name} has two names here: {owners[own]}, {name}"
            )
            report.add(path, message, "one name for each interface")
        else:
            owners[own] = name


def _check_ports(index: Index, station: StationSection, report: FindingReport) -> None:
    """Report ports whose address the host of their station does not have."""
    host = index.hosts.get(station.name)
    if host is None:
        return
    for port in station.ports:
        uri = index.uris.get((station.name, port.name))
        if uri is None or uri.scheme not in {"udp", "tcp"}:
            continue
        address = IPv4Address(uri.host)
        if address.is_unspecified or address.is_loopback or has_address(host, address):
            continue
        owner = next((each for each in index.plant.hosts if has_address(each, address)), None)
        message = f"{uri.host} of {station.name}/{port.name} is no address of its host {host.name}"
        if owner is not None:
            message += f", but of host {owner.name}"
        own = ", ".join((host.address, *host.addresses))
        expected = f"one of {own}, or the address in addresses: of host {host.name}"
        report.add(f"{port.at}.interface", message, expected)


def _check_lines(index: Index, report: FindingReport) -> None:
    """Report lines within one host (``loop://``) that ports of several hosts are on."""
    first: dict[str, tuple[str, str]] = {}
    for (station, name), uri in index.uris.items():
        if uri.scheme != "loop":
            continue
        other = first.setdefault(uri.host, (station, name))
        if index.are_apart(station, other[0]):
            message = (
                f"{uri} joins {'/'.join(other)} on host {index.hosts[other[0]].name} and"
                f" {station}/{name} on host {index.hosts[station].name}: it exists within one host"
            )
            port = index.ports[station, name]
            report.add(f"{port.at}.interface", message, "udp:// or ethernet:// between hosts")


def _check_frames(index: Index, station: StationSection, report: FindingReport) -> None:
    """Report frames to a loopback address that a station of another host has."""
    for frame in station.frames:
        uri = index.uris.get((station.name, frame.port))
        if uri is None:
            continue
        try:
            destination = resolve_destination(frame.to, uri, index)
        except ValueError:
            continue  # a finding of its own, or the requester
        for name in sorted(_owners(index, destination)):
            if index.are_apart(station.name, name):
                hosts = f"{name} runs on host {index.hosts[name].name}"
                message = f"frame {frame.name!r} goes to {destination.host}, which does not leave"
                message += f" this host: {hosts}"
                report.add(f"{frame.at}.to", message, "an address that other hosts reach")


def _owners(index: Index, destination: Destination) -> Iterator[str]:
    """Yield the stations that have the loopback address *destination*, none for other ones."""
    if destination.kind not in {DestinationKind.IP, DestinationKind.TCP}:
        return
    if not IPv4Address(destination.host).is_loopback:
        return
    for (station, _), uri in index.uris.items():
        if uri.scheme in {"udp", "tcp"} and uri.host == destination.host:
            yield station


def _check_senders(index: Index, station: StationSection, report: FindingReport) -> None:
    """Report subscriptions to PDs that leave another host's loopback address."""
    for subscription in station.subscribe:
        for sent in index.publishers(subscription):
            name = sent.station.name
            if not index.are_apart(station.name, name):
                continue
            own = index.uris.get((station.name, subscription.port))
            ports: list[tuple[str, PortSection, InterfaceUri | None]] = [
                (name, sent.port, index.uris.get((name, sent.port.name)))
            ]
            if (port := index.eap_port(station, subscription.port)) is not None:
                ports.append((station.name, port, own))
            for owner, port, uri in ports:
                if uri is not None and uri.scheme != "loop" and is_local_only(uri):
                    message = (
                        f"subscription {subscription.name!r} of host"
                        f" {index.hosts[station.name].name} receives from host"
                        f" {index.hosts[name].name}, but {owner}/{port.name} is at {uri}"
                    )
                    report.add(subscription.at, message, "addresses that other hosts reach")


def _check_servers(index: Index, report: FindingReport) -> None:
    """Report servers of optional processes at an address that no host has."""
    for server in find_servers(index.plant):
        try:
            address = IPv4Address(server.listen.host)
        except ValueError:
            continue  # IPv6: the plant file does not say whose address it is
        # Each host has these: the server runs on all of them.
        if server.listen.is_any or server.listen.is_loopback:
            continue
        if not any(has_address(host, address) for host in index.plant.hosts):
            message = f"{server.name} listens at {server.listen.host}, which no host has"
            report.add(server.at, message, "an address of a host, or 127.0.0.1")


def _check_bridge_names(index: Index, report: FindingReport) -> None:
    """Report names by which the bridges of all hosts would be one client of a broker."""
    mqtt = index.plant.mqtt
    if mqtt is None or len(index.plant.hosts) == 1:
        return
    names = {"client_id": mqtt.client_id}
    if mqtt.sparkplug is not None:
        names["sparkplug.node"] = mqtt.sparkplug.node
    for key, name in names.items():
        if name:
            message = f"{key} {name!r} would be that of each host"
            report.add(f"{mqtt.at}.{key}", message, "none: each host then has one of its own")


def is_served_on(host: HostSection, listen: str) -> bool:
    """Return whether a server that listens at *listen* runs on *host*."""
    where = parse_listen(listen)
    if where.is_any or where.is_loopback:
        return True
    try:
        return has_address(host, IPv4Address(where.host))
    except ValueError:
        return True  # IPv6: the plant file does not say whose address it is


def find_host(
    plant: str,
    hosts: Sequence[HostSection],
    wanted: str,
    names: Collection[str],
    addresses: Collection[str],
) -> HostSection:
    """Return the host of *plant* that this computer is.

    Args:
        plant: Its name, for messages.
        hosts: Those of the plant, at least one.
        wanted: Name of the host; empty to find it by name and address.
        names: Names of this computer.
        addresses: IPv4 addresses of this computer.

    Raises:
        ConfigError: there is no such host, or this computer is none or several of them.
    """
    known = {host.name: host for host in hosts}
    if wanted:
        if wanted not in known:
            hint = suggest(wanted, known) or f": it has {', '.join(known)}"
            raise ConfigError(f"plant {plant} has no host {wanted!r}{hint}")
        return known[wanted]
    every = map(IPv4Address, addresses)
    # Every computer has the loopback addresses: they tell none from the others.
    outside = [each for each in every if not each.is_loopback]
    found = {}
    for host in hosts:
        if host.name in names or host.address in names:
            found[host.name] = f"by name {host.name if host.name in names else host.address}"
        elif own := [str(each) for each in outside if _is_at(host, each)]:
            found[host.name] = f"by address {own[0]}"
    if len(found) == 1:
        return known[next(iter(found))]
    choose = "choose one with --host NAME"
    if found:
        which = ", ".join(f"{name} ({why})" for name, why in found.items())
        raise ConfigError(
            f"plant {plant}: this computer is several of its hosts: {which}; {choose}"
        )
    where = ", ".join(f"{host.name} at {host.address}" for host in hosts)
    mine = ", ".join((*names, *map(str, outside)))
    raise ConfigError(
        f"plant {plant}: this computer ({mine}) is none of its hosts, {where}; {choose}"
    )


def _is_at(host: HostSection, address: IPv4Address) -> bool:
    # A network is none of the addresses: other hosts may be in it, too.
    return str(address) in {host.address, *host.addresses}
