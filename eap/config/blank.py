"""A station that no plant file describes: one EAP port, nothing sent and nothing received yet."""

from __future__ import annotations

from pathlib import Path

from eap.config.check_ports import check_ports
from eap.config.derive import derive
from eap.config.derive_routing import derive_directory, derive_routing
from eap.config.finding import Report
from eap.config.index import Index
from eap.config.load import LoadResult, Plant
from eap.config.structs import PlantFile, Port, Station
from eap.ids import NetId
from eap.pd.spec import PortKind

PORT = "eap0"
_ROUTER, _PORT = "station", "port"
INTERFACE_PATH = f"{_PORT}.interface"
NET_ID_PATHS = f"{_PORT}.net_id", f"{_ROUTER}.net_id"


def blank(name: str, interface: str, net_id: str, cycle_us: int) -> LoadResult:
    """Return a plant called *name* that has one station of that name.

    A plant file's rules hold, and findings are told by their paths above.  *net_id* is that of the
    port: publisher ID of its frames and address of its dictionary.  The router of a station has a
    NetID of its own, which here is the port's with its fifth octet one less.

    Args:
        name: Of plant and station.
        interface: Of the port, as in a plant file.
        net_id: Of the port.
        cycle_us: Device cycle.
    """
    port = Port(at=_PORT, name=PORT, kind=PortKind.EAP, interface=interface, net_id=net_id)
    station = Station(
        at=_ROUTER, name=name, net_id=_router(net_id), ports=(port,), cycle_us=cycle_us
    )
    index = Index(PlantFile(plant="blank", stations=(station,)))
    report = Report("")
    check_ports(index, report)
    if findings := report.findings():
        return LoadResult(None, findings)
    plant = Plant(
        name, derive(index, Path()), derive_routing(index, Path()), derive_directory(index)
    )
    return LoadResult(plant, ())


def _router(net_id: str) -> str:
    try:
        octets = bytearray(NetId.parse(net_id))
    except ValueError:
        return net_id  # wrong there as it is wrong at the port
    octets[4] = (octets[4] - 1) & 0xFF
    return str(NetId(octets))
