"""What a station's specification wants of TCP at one of its ports."""

from __future__ import annotations

from eap.ids import Destination, DestinationKind, InterfaceUri
from eap.net.tcpport import TcpPort
from eap.pd.link import FrameChannel
from eap.pd.spec import REQUESTER, PortSpec, StationSpec
from eap.pd.station import Station


def sends_to(spec: StationSpec, port: str) -> set[str]:
    """Return the destinations to which frames of *port* go by TCP."""
    destinations = {frame.destination for frame in spec.frames if frame.port == port} - {REQUESTER}
    return {each for each in destinations if Destination.parse(each).kind is DestinationKind.TCP}


def has_tcp(spec: StationSpec, port: PortSpec) -> bool:
    """Tell whether anything goes or comes by TCP at *port*."""
    return port.tcp or port.interface.startswith("tcp:") or bool(sends_to(spec, port.name))


def open_tcp_port(spec: PortSpec, datagrams: FrameChannel | None) -> TcpPort:
    """Return the channel of a port with TCP, beside its *datagrams* if it has any."""
    return TcpPort(InterfaceUri.parse(spec.interface).host, datagrams)


def follow(port: TcpPort, station: Station, name: str) -> None:
    """Have *port* do what *station* wants of it at its port *name*."""
    spec = station.spec
    asks = any(pd.poll_request and pd.port == name for pd in spec.subscriptions)
    port.follow(sends_to(spec, name), [station.takers[name]] if asks else [])
