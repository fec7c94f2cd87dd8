"""Bus ports of a plant file: bus files, mailbox gateways, and checks of both."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

from msgspec.structs import replace

from eap.codec.ams import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.finding import FindingReport, PlantFinding
from eap.config.index import ExpectedBus, Index
from eap.config.plant_sections import PlantFile
from eap.config.routes import SectionError
from eap.config.slaves import check_cycles, override
from eap.config.structs import Plain, PortSection, StationSection
from eap.ids import InterfaceUri, is_host
from eap.od.slave_config import SlaveConfig
from eap.pd.spec import GatewayAddress, GatewaySpec, PortKind
from eap.suggest import suggest

DescribeBus: TypeAlias = Callable[[Path], ExpectedBus | tuple[PlantFinding, ...]]
"""Reads a bus file; returns its findings if it has any, and never raises for its content."""


SCHEMES = ("sim", "ethernet", "udp")
INTERFACE = "sim:// and a bus file, ethernet://NAME or udp://ADDRESS"
_FILE = "a bus file, its path from the plant file on"
_SLAVE_NAME = "a text without spaces and slashes, by which a plant can address it"


def check_bus_port(port: PortSection, uri: InterfaceUri, report: FindingReport) -> None:
    """Report an interface that no bus port can have."""
    path = f"{port.at}.interface"
    if uri.scheme not in SCHEMES:
        report.add(path, f"{uri.scheme}:// is no interface of a bus port", INTERFACE)
        return
    if uri.options:
        report.add(path, f"{uri.scheme}:// takes no options", f"{uri.scheme}://{uri.host}")
    if uri.scheme == "udp" and not is_host(uri.host):
        report.add(path, f"{uri.host} is no address of a bus", "the address of one segment")
    if uri.scheme == "sim" and port.bus and Path(port.bus) != Path(uri.host):
        message = f"port {port.name} simulates {uri.host}, but is described by {port.bus}"
        report.add(f"{port.at}.bus", message, "no key bus: the simulated file is the description")
    if port.redundant:
        _check_second_line(port, uri, report)


def _check_second_line(port: PortSection, uri: InterfaceUri, report: FindingReport) -> None:
    """Report an interface that the second line of a ring cannot have."""
    path = f"{port.at}.redundant"
    try:
        second = InterfaceUri.parse(port.redundant)
    except ValueError as exc:
        report.add(path, f"redundant: {exc}", f"an interface, such as {uri.scheme}://…")
        return
    if second.scheme != uri.scheme or second.options:
        expected = f"another {uri.scheme}:// interface, without options"
        report.add(path, f"{second} is no second line beside {uri}", expected)
    elif uri.scheme == "sim" and Path(second.host) != Path(uri.host):
        report.add(path, f"the second line simulates {second.host}", f"{uri}: both lines of a ring")
    elif uri.scheme != "sim" and (second.host, second.port) == (uri.host, uri.port):
        report.add(path, f"{second} is the first line, too", "another interface")


def uses_sync(configs: Iterable[SlaveConfig]) -> bool:
    """Return whether a slave is configured for SYNC0."""
    return any(each.sync is not None and each.sync.activate >> 8 for each in configs)


def locked_port(index: Index, station: StationSection) -> str:
    """Return the bus port whose reference clock the cycle of *station* follows, or nothing.

    That is the one with ``lock_cycle: true``, else the first whose slaves use SYNC0.
    """
    ports = [port for port in station.ports if port.kind is PortKind.BUS]
    for port in ports:
        if port.lock_cycle:
            return port.name
    for port in ports:
        slaves = index.buses[station.name, port.name].slaves
        if port.lock_cycle is None and uses_sync(each.config for each in slaves):
            return port.name
    return ""


def _check_locks(
    plant: PlantFile,
    buses: Mapping[tuple[str, str], ExpectedBus | None],
    report: FindingReport,
) -> None:
    """Report cycles that would have to follow two clocks, or none."""
    for station in plant.stations:
        locked = [port for port in station.ports if port.lock_cycle]
        for port in locked[1:]:
            message = f"the cycle of {station.name} follows the clocks of {locked[0].name} already"
            report.add(f"{port.at}.lock_cycle", message, "one bus with lock_cycle for a station")
        for port in locked[:1]:
            bus = buses.get((station.name, port.name)) or ExpectedBus()
            if not port.clocks and not uses_sync(slave.config for slave in bus.slaves):
                message = f"the clocks of {port.name} are not kept together"
                report.add(f"{port.at}.lock_cycle", message, "clocks: true, or slaves with sync0")


def describe_buses(
    plant: PlantFile, folder: Path, describe: DescribeBus, report: FindingReport
) -> dict[tuple[str, str], ExpectedBus | None]:
    """Return the description of the bus at each (station, port); None if its file is invalid.

    Findings of the files go to *report*.
    """
    found: dict[tuple[str, str], ExpectedBus | None] = {}
    known: dict[Path, ExpectedBus | None] = {}
    for station, port in _bus_ports(plant):
        path, file = bus_file(port, folder)
        if file is None:
            description: ExpectedBus | None = ExpectedBus()
        elif reason := _unusable(file):
            report.add(path, f"bus file {file} {reason}", _FILE)
            description = None
        else:
            # A simulated bus may be named by several stations; building its slaves takes long.
            if file not in known:
                known[file] = _describe(file, describe, report)
            description = known[file]
        if description is not None and not _has_names(path, port, description, report):
            description = None
        is_line = description is not None and not description.is_ring
        if is_line and port.redundant.startswith("sim:") and port.redundant == port.interface:
            message = f"{file} has one line to the master only"
            report.add(f"{port.at}.redundant", message, "ring: true in the bus file")
        if description is not None:
            description = _configure(plant, station, port, description, report)
        # The first of two ports of one name counts, as everywhere in the index.
        found.setdefault((station.name, port.name), description)
    _check_locks(plant, found, report)
    return found


def _configure(
    plant: PlantFile,
    station: StationSection,
    port: PortSection,
    description: ExpectedBus,
    report: FindingReport,
) -> ExpectedBus:
    """Return the bus with the configuration that the plant file has for its slaves."""
    slaves = override(description.slaves, port.slaves, report, f"{port.at}.slaves")
    cycle_us = station.cycle_us or plant.defaults.cycle_us
    check_cycles({slave.name: slave for slave in slaves}, cycle_us, report, port.at)
    return replace(description, slaves=slaves)


def bus_file(port: PortSection, folder: Path) -> tuple[str, Path | None]:
    """Return the path in the plant file that names the bus file of *port*, and the file, if any."""
    try:
        uri = InterfaceUri.parse(port.interface)
    except ValueError:
        uri = None
    if uri is not None and uri.scheme == "sim":
        return f"{port.at}.interface", folder / uri.host
    return f"{port.at}.bus", folder / port.bus if port.bus else None


def _unusable(file: Path) -> str:
    """Return the reason that *file* cannot be read; empty if it can."""
    try:
        if file.is_file():
            return ""
        return "is no regular file" if file.exists() else "does not exist"
    except OSError as exc:
        return f"cannot be read: {exc.strerror}"


def _bus_ports(plant: PlantFile) -> Iterator[tuple[StationSection, PortSection]]:
    for station in plant.stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                yield station, port


def _describe(file: Path, describe: DescribeBus, report: FindingReport) -> ExpectedBus | None:
    description = describe(file)
    if isinstance(description, ExpectedBus):
        report.warnings += description.warnings
        return description
    report.adopt(description)
    return None


def _has_names(
    path: str, port: PortSection, description: ExpectedBus, report: FindingReport
) -> bool:
    """Return whether all slaves can be addressed, after reporting those that cannot."""
    wrong = [
        slave.name
        for slave in description.slaves
        if not slave.name or any(each.isspace() or each == "/" for each in slave.name)
    ]
    for name in wrong:
        report.add(path, f"port {port.name} has a slave {name!r}", _SLAVE_NAME)
    return not wrong


MASTER_PORT = 0xFFFF
ADDRESS = "a mailbox address from 1 to 0xFFFE"
TARGET = (
    "a station address or the name of a slave, STATION/PORT/SLAVE, or a list of these addresses"
)
_MEMBER = "station addresses, names of slaves of this bus, and virtual addresses"
_LAST = 0xFFFE


def gateway_spec(index: Index, station: StationSection, port: PortSection) -> GatewaySpec:
    """Return the specification of the gateway of a bus port; the checks have passed it."""
    section = port.gateway
    return GatewaySpec(
        enabled=section.enabled,
        port=gateway_port(station, port),
        answer_ms=section.answer_ms,
        silent=section.silent,
        full=section.full,
        padded=section.padded,
        addresses=tuple(
            resolve_gateway_address(index, station, port, parse_address(text), target)
            for text, target in section.addresses.items()
        ),
        in_flight=section.limits.in_flight,
        rate=section.limits.rate,
        clients=section.limits.clients,
    )


def gateway_port(station: StationSection, port: PortSection) -> int:
    """Return the port number of a gateway of its own, 0 for none.

    The gateway to the first bus shares the port of the station, 34980.
    """
    # A UDP and TCP port serves one master; each further bus of a station needs its own.
    buses = [each.name for each in station.ports if each.kind is PortKind.BUS]
    number = buses.index(port.name)
    return port.gateway.port or (EAP_PORT + number if number else 0)


def ip_addresses_of(index: Index, station: StationSection) -> Iterator[str]:
    """Yield the IP addresses of a station, each once."""
    uris = (index.uris.get((station.name, name)) for name in station.eap_ports)
    found = (uri.host for uri in uris if uri is not None and uri.scheme in {"udp", "tcp"})
    yield from dict.fromkeys(found)


def parse_address(text: str) -> int:
    """Return a virtual address as a plant file has it; raise SectionError if it is invalid."""
    try:
        address = int(text, 0)
    except ValueError:
        address = 0
    if not 0 < address <= _LAST:
        raise SectionError(text, f"gateway address {text!r}", ADDRESS)
    return address


def resolve_gateway_address(
    index: Index, station: StationSection, port: PortSection, address: int, target: Plain
) -> GatewayAddress:
    """Return the target of *address*; raise SectionError if it does not exist."""
    if isinstance(target, list):
        known = _virtual(port)
        members = tuple(_member(index, station, port, each, known) for each in target)
        if not members:
            raise SectionError("", "a group without addresses", _MEMBER)
        return GatewayAddress(address, members=members)
    names = str(target).split("/")
    if len(names) == 1:
        return GatewayAddress(address, station=find_slave(index, station, port, target))
    other = index.stations.get(names[0])
    other_port = index.ports.get((names[0], names[1]))
    if other is None or other_port is None or other_port.kind is not PortKind.BUS or len(names) > 3:
        buses = [f"{at}/{name}" for (at, name), each in index.ports.items() if _is_bus(each)]
        hint = suggest("/".join(names[:2]), buses)
        raise SectionError("", f"there is no bus port for {target!r}{hint}", TARGET)
    number = find_slave(index, other, other_port, names[2]) if len(names) == 3 else MASTER_PORT
    if other_port is port and number != MASTER_PORT:
        # On the same bus no router is needed between gateway and slave.
        return GatewayAddress(address, station=number)
    slaves = index.slaves(other, other_port.name)
    found = [each.name for each in slaves if each.station == number] or names[2:]
    name = "/".join([*names[:2], *found])
    return GatewayAddress(address, net_id=str(other_port.net_id), port=number, name=name)


def _member(
    index: Index,
    station: StationSection,
    port: PortSection,
    member: object,
    known: dict[int, Plain],
) -> int:
    # YAML 1.2 reads 0x1001 as a number already; a quoted one is still a text here.
    text = str(member)
    if text.lower().startswith("0x") or isinstance(member, int):
        number = int(text, 0)
        if number in known:
            if isinstance(known[number], list):
                raise SectionError("", f"0x{number:04X} is a group itself", _MEMBER)
            return number
    return find_slave(index, station, port, member)


def find_slave(index: Index, station: StationSection, port: PortSection, slave: object) -> int:
    """Return the station address of a slave, given by that address or by its name.

    Raises:
        SectionError: the bus has no such slave.
    """
    slaves = index.slaves(station, port.name)
    for each in slaves:
        if slave in {each.name, each.station} or str(slave) == str(each.station):
            return each.station
    name = f"{station.name}/{port.name}"
    text = str(slave)
    if text.isdecimal() or isinstance(slave, int):
        number = int(text, 0)
        if not slaves and 0 < number <= _LAST:
            return number  # nothing describes the bus: any slave may be there
        last = f"; its last one is {slaves[-1].station}" if slaves else ""
        raise SectionError("", f"{name} has no slave {number}{last}", TARGET)
    hint = suggest(text, [each.name for each in slaves])
    raise SectionError("", f"{name} has no slave {text!r}{hint}", TARGET)


def _virtual(port: PortSection) -> dict[int, Plain]:
    found: dict[int, Plain] = {}
    for text, target in port.gateway.addresses.items():
        try:
            found[parse_address(text)] = target
        except SectionError:
            continue  # a finding of its own
    return found


def _is_bus(port: PortSection) -> bool:
    return port.kind is PortKind.BUS


_ANY = "0.0.0.0"  # noqa: S104  what a plant file may say
_BIT_15 = 0x8000


def check_gateways(index: Index, report: FindingReport) -> None:
    """Report every invalid gateway."""
    taken = list(_used_ports(index))
    for station in index.plant.stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                _check_addresses(index, station, port, report)
                _check_port_number(index, station, port, taken, report)


def _check_addresses(
    index: Index, station: StationSection, port: PortSection, report: FindingReport
) -> None:
    path = f"{port.at}.gateway.addresses"
    first: dict[int, str] = {}
    stations = {slave.station for slave in index.slaves(station, port.name)}
    is_unresolved = port.name in index.unread_buses(station)
    for text, target in port.gateway.addresses.items():
        try:
            address = parse_address(text)
            if address in first:
                message = f"gateway address {text} is a duplicate of {first[address]}"
                report.add(f"{path}.{text}", message, "each address once")
                continue
            first[address] = text
            # With bit 15 set, the station address is the same slave with its address in the answer.
            if address & _BIT_15 and address & ~_BIT_15 in stations:
                slave = address & ~_BIT_15
                message = f"gateway address {text} is that of slave {slave} with bit 15 set"
                report.add(f"{path}.{text}", message, f"{ADDRESS} that is not in use")
            resolve_gateway_address(index, station, port, address, target)
        except SectionError as exc:
            if not is_unresolved:
                report.add(f"{path}.{text}", str(exc), exc.expected)
        except ValueError:
            continue  # a NetID that is a finding of its own


def _check_port_number(
    index: Index,
    station: StationSection,
    port: PortSection,
    taken: list[tuple[str, int, str, str]],
    report: FindingReport,
) -> None:
    number = gateway_port(station, port)
    if not number:
        return
    path = f"{port.at}.gateway.port"
    if path not in report.lines:
        # A number that was not given has no line: the finding goes to the port.
        path = port.at
    for host in ip_addresses_of(index, station):
        for other_host, other_number, what, at in taken:
            if other_number == number and (host == other_host or _ANY in {host, other_host}):
                line = report.line_of(at)
                message = (
                    f"the gateway to {port.name} is served at {host}, port {number}, which"
                    f" belongs to {what} (line {line})"
                )
                report.add(path, message, f"gateway: {{port: NUMBER}} that is free at {host}")
                return
        taken.append((host, number, f"the gateway to {station.name}/{port.name}", path))


def _used_ports(index: Index) -> Iterator[tuple[str, int, str, str]]:
    """Yield the addresses in use by ports: host, port number, owner, and path in the file."""
    for (station, name), uri in index.uris.items():
        port = index.ports[station, name]
        path = f"{port.at}.interface"
        if uri.scheme in {"udp", "tcp"}:
            yield uri.host, uri.port or EAP_PORT, f"{station}/{name}", path
            if port.kind is PortKind.EAP and port.ams:
                yield uri.host, AMS_TCP_PORT, f"AMS at {station}/{name}", path
                # UDP 48899, on which tools ask for routers.
                yield uri.host, AMS_TCP_PORT + 1, f"AMS at {station}/{name}", path
