"""Loading of a plant file, or of a plant without one: stations, or findings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec

from eap.ams.spec import DirectoryStation, RoutingSpec
from eap.config.access import check_access
from eap.config.brokers import check_learning, warn_of_open_brokers
from eap.config.bus import DescribeBus, describe_buses
from eap.config.check_ports import check_ports
from eap.config.check_publish import check_polls, check_publish
from eap.config.check_routes import check_routes, follow_routes
from eap.config.check_subscribe import check_subscribe
from eap.config.check_variables import check_variables
from eap.config.convert import convert, read_net_id
from eap.config.derive import derive, derive_directory, derive_routing
from eap.config.document import read
from eap.config.finding import FindingReport, PlantFinding
from eap.config.gateways import check_gateways
from eap.config.index import Index
from eap.config.links import check_links
from eap.config.structs import AuditDuty, PlantFile, PortSection, StationSection
from eap.ids import NetId
from eap.pd.spec import PortKind, StationSpec


class Plant(msgspec.Struct, frozen=True):
    """A checked plant, complete."""

    name: str
    stations: tuple[StationSpec, ...]
    routing: Mapping[str, RoutingSpec] = {}
    """Specification of the router of each station."""
    directory: tuple[DirectoryStation, ...] = ()
    """The names of everything in the plant."""
    audit_required: bool = False
    """Whether changes that cannot be recorded are refused."""


class PlantResult(msgspec.Struct, frozen=True):
    """Either a plant and no findings, or no plant and all findings in the order of the file."""

    plant: Plant | None
    findings: tuple[PlantFinding, ...]
    lines: Mapping[str, int] = {}
    """Of a plant: the line of each path of its file."""
    warnings: tuple[PlantFinding, ...] = ()
    """Of a plant: what is worth a look."""


def load(path: Path, describe_bus: DescribeBus) -> PlantResult:
    """Read, check and complete the plant file at *path*; never raises for what the file holds.

    *describe_bus* reads the bus files that it names; their findings follow its own.
    """
    report = FindingReport(str(path))
    root = read(path, report)
    plant_file = None if root is None else convert(root, report)
    if plant_file is None:
        return PlantResult(None, report.findings())
    report.stations |= {station.name for station in plant_file.stations}
    index = Index(plant_file, describe_buses(plant_file, path.parent, describe_bus, report))
    check_ports(index, report)
    check_gateways(index, report)
    check_variables(index, report, path.parent)
    check_publish(index, report)
    check_subscribe(index, report)
    check_polls(index, report)
    check_links(index, report)
    check_routes(index, report, path.parent)
    check_learning(index, report)
    check_access(index, report, path.parent)
    if findings := report.findings():
        return PlantResult(None, findings)
    plant = Plant(
        plant_file.plant,
        derive(index, path.parent),
        derive_routing(index, path.parent),
        derive_directory(index),
        audit_required=plant_file.access.audit is AuditDuty.REQUIRED,
    )
    warnings = (*follow_routes(index, plant.routing, report), *warn_of_open_brokers(index, report))
    return PlantResult(plant, (), report.lines, warnings)


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
    octets[4] = (octets[4] - 1) & 0xFF
    return NetId(octets)
