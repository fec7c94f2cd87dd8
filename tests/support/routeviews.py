"""Routers of stations with routes that are kept, for tests of what people see of them."""

from __future__ import annotations

from eap.ams.directory import Directory
from eap.ams.spec import (
    DirectoryPort,
    DirectoryStation,
    HopSpec,
    RouteSpec,
    RoutingSpec,
    TransportKind,
)
from eap.ams.transport_table import Transport
from eap.codec.ams import SYSTEM_PORT, AmsAnswer
from eap.ids import Endpoint, InterfaceUri, NetId
from eap.runtime.store import StationStore
from eap.services.routing.route_rows import RouterView
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from tests.support.routing import RecordingSender, StubService

DIRECTORY = Directory([
    DirectoryStation(
        name, NetId.parse(f"127.0.9.{number}.1.1"),
        (DirectoryPort("eap0", False, NetId.parse(f"127.0.9.{number}.2.1"), InterfaceUri.parse(f"udp://127.0.9.{number}")),),
    )
    for number, name in ((1, "left"), (2, "right"), (3, "third"))
])  # fmt: skip
RIGHT = RouteSpec(
    name="right", net_id="127.0.9.2.1.1", hop=HopSpec(TransportKind.UDP, "eap0", "127.0.9.2:34980"),
    router="127.0.9.2.1.1", is_derived=True,
)  # fmt: skip


def _run(request: LocalRequest) -> AmsAnswer:
    """Tell ADS state RUN, whatever is asked."""
    del request
    return AmsAnswer(bytes.fromhex("00000000 0500 0000"))


class Left:
    """Station left: its router has a transport by UDP and one by AMS/TCP, and knows station right.

    Attributes:
        sent: What leaves by any transport.
    """

    def __init__(self) -> None:
        station = DIRECTORY.stations["left"]
        net_ids = [port.net_id for port in station.ports]
        net_id = station.net_id
        self.router = StationRouter("left", net_id, net_ids)
        self.router.add_service(net_id, StubService(_run, SYSTEM_PORT))
        self.sender = RecordingSender()
        self.router.add_transport(Transport("udp:eap0", is_hub=True), self.sender)
        self.routes = StationRoutes(
            self.router, RoutingSpec(routes=(RIGHT,)), StationStore("hall", "left").routes,
            open_hop=self._open,
        )  # fmt: skip
        self.routes.start()
        self.view = RouterView(self.router, self.routes)

    def _open(self, hop: HopSpec) -> Endpoint:
        name = f"{hop.kind}:{hop.port or hop.address}"
        is_uplink = hop.kind in {TransportKind.AMS_TCP, TransportKind.AMS_TLS}
        if is_uplink and name not in self._transports():
            self.router.add_transport(Transport(name, is_stream=True), self.sender)
        if name not in self._transports():
            raise ValueError(f"this station has no transport {name}")
        return Endpoint(name, hop.address)

    def _transports(self) -> object:
        return self.router._senders
