"""Stations whose routers are real and whose links are function calls, for tracing and scanning."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from eap.ads.request import ReadWrite, parse_request
from eap.ams.access import AccessList
from eap.ams.record import Record
from eap.ams.report import HopQuestion, Location, encode_report
from eap.ams.router import Router
from eap.ams.routes import Route, RouteTable
from eap.ams.spec import AccessRule
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError, IndexGroup, encode_result
from eap.codec.ams import SYSTEM_PORT, AmsAnswer, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from eap.services.routing.tracing import answer_hop_query

Serve = Callable[[int, int, bytes], AmsAnswer]
"""Answers port, command and body in the place of a station's devices."""


def run_state(port: int, command: int, body: bytes) -> AmsAnswer:
    del port, body
    if command == AmsCommand.READ_STATE:
        return AmsAnswer(encode_result(0) + bytes((5, 0, 8, 0)))
    return AmsAnswer(error_code=AdsError.COMMAND)


class Station:
    """One station; *devices* are NetIDs of its ports with the AMS ports behind them."""

    def __init__(
        self,
        line: Line,
        number: int,
        routes: Iterable[Route],
        serve: Serve,
        rules: Iterable[AccessRule] = (),
    ) -> None:
        self.name = f"island-{number:02}"
        self.net_id = NetId.parse(f"5.1.1.{number}.1.1")
        self.line = line
        self.serve = serve
        self.is_ours = True
        self.faults: dict[tuple[NetId, int], tuple[str, ...]] = {}
        self.router = Router(
            self.net_id,
            RouteTable([*routes]),
            [Transport("local"), Transport("link", is_hub=True)],
            first_invoke_id=1,
            access=AccessList([*rules]),
        )
        self.router.add_device(self.net_id, {300, SYSTEM_PORT})
        self.router.add_device(NetId.parse(f"5.1.1.{number}.3.1"), {0xFFFF, 1001})

    async def find_faults(self, net_id: NetId, port: int) -> tuple[str, ...]:
        return self.faults.get((net_id, port), ())

    @property
    def record(self) -> Record:
        return self.router.record

    def locate(self, header: AmsHeader, endpoint: Endpoint) -> Location:
        return self.router.locate(header, endpoint)

    async def request(
        self, target: NetId, target_port: int, command: int, body: bytes = b"", *, timeout_s: float
    ) -> AmsAnswer:
        del timeout_s
        return await self.line.carry(
            self, Endpoint("local", "1"), target, target_port, command, body
        )


class Line:
    """All of them; *dead* are names of those that do not answer."""

    def __init__(self) -> None:
        self.stations: dict[str, Station] = {}
        self.dead: set[str] = set()

    def add(
        self,
        number: int,
        *routes: Route,
        serve: Serve = run_state,
        rules: Iterable[AccessRule] = (),
    ) -> Station:
        station = Station(self, number, routes, serve, rules)
        self.stations[station.name] = station
        return station

    async def carry(
        self,
        station: Station,
        endpoint: Endpoint,
        target: NetId,
        port: int,
        command: int,
        body: bytes,
    ) -> AmsAnswer:
        header = AmsHeader(target, port, station.net_id, 1, command)
        location = station.locate(header, endpoint)
        if location.is_here:
            return await self._serve(station, endpoint, port, command, body)
        if location.why or location.route is None:
            return AmsAnswer(error_code=AdsError.TARGET_MACHINE)
        hop = location.route.route.hop
        if hop.connection in self.dead:
            return AmsAnswer(error_code=AdsError.TIMEOUT)
        further = self.stations[hop.connection]
        back = Endpoint("link", station.name)
        target = location.route.route.to_real(target)
        return await self.carry(further, back, target, port, command, body)

    async def _serve(
        self, station: Station, endpoint: Endpoint, port: int, command: int, body: bytes
    ) -> AmsAnswer:
        if port == SYSTEM_PORT and command == AmsCommand.READ_WRITE and station.is_ours:
            (asked,) = parse_request(command, body).operations
            assert isinstance(asked, ReadWrite)
            assert asked.group == IndexGroup.ROUTE_QUERY
            question = HopQuestion.decode(asked.data)
            report = await answer_hop_query(station, question, endpoint, NetId.parse("9.9.9.9.1.1"))
            return AmsAnswer(encode_result(0, encode_report(report)))
        return station.serve(port, command, body)


def to(number: int, through: int | None = None, **more: object) -> Route:
    """Return a route to a station, by the one next to it."""
    next_one = number if through is None else through
    return Route(
        NetId.parse(f"5.1.1.{number}.1.1"),
        f"island-{number:02}",
        Endpoint("link", f"island-{next_one:02}"),
        router=NetId.parse(f"5.1.1.{next_one}.1.1"),
        **more,  # type: ignore[arg-type]
    )
