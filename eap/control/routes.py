"""Control protocol: routes, and AMS requests through a router.

The records of requests and answers, which server and client share; docs/control.md describes them.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, field

from eap.ams.report import HopReport
from eap.control.protocol import Document, Method, Parameters

PAGE = 1000
"""Most routes of one answer."""
MAX_XML = 1 << 20
"""Characters of a file with routes."""
MAX_TEXT = 255
MAX_TIMEOUT_MS = 60_000

Text: TypeAlias = Annotated[str, Meta(max_length=MAX_TEXT)]
OriginName: TypeAlias = Literal["static", "derived", "added", "learned"]
StateName: TypeAlias = Literal["up", "down", "unknown", "client"]


class RoutesListParameters(Parameters, frozen=True, kw_only=True):
    """``routes_list``: of one station, or of all.

    Of each station *count* routes from number *first* on, of those that have *match* in their name,
    NetID, transport, address, origin or state; and the latest *requests*.
    """

    station: str = ""
    match: Text = ""
    first: Annotated[int, Meta(ge=0)] = 0
    count: Annotated[int, Meta(ge=0, le=PAGE)] = PAGE
    requests: Annotated[int, Meta(ge=0, le=256)] = 50


class RoutesAddParameters(Parameters, frozen=True, kw_only=True):
    """``routes_add``: a route that is kept, until it is removed.

    Attributes:
        station: Whose router gets it.
        name: As people call it.
        net_id: Of the station that it leads to; empty if *name* is a station of the plant.
        via: Where packets go: ``STATION/PORT`` of the plant, or a kind of transport and an address,
            such as ``ams-tcp:192.168.1.5``, ``udp:10.0.0.5``, ``mqtt:NETWORK``.
        port: EAP port that they leave by; empty for the first that can.
        octets: How many octets of a NetID have to be those of *net_id*; 0 for a default route.
        virtual: NetID by which the station is known here; empty for its own.
        unidirectional: Whether requests from there are refused.
        timeout_ms: How long an answer may take; 0 for as long as usual.
        probed: Whether the next hop is probed from time to time.
        replaces: Name or NetID of an added route that this one takes the place of; empty for none.
    """

    station: str
    name: Text
    net_id: Text = ""
    via: Text
    port: Text = ""
    octets: Literal[0, 4, 5, 6] = 4
    virtual: Text = ""
    unidirectional: bool = False
    timeout_ms: Annotated[int, Meta(ge=0, le=600_000)] = 0
    probed: bool = True
    replaces: Text = ""


class RoutesRemoveParameters(Parameters, frozen=True, kw_only=True):
    """``routes_remove``: by name or NetID; *transport* and *address* choose among several."""

    station: str
    route: Text
    transport: Text = ""
    address: Text = ""


class RoutesTestParameters(Parameters, frozen=True, kw_only=True):
    """``routes_test``: asks *target* for its state.

    It is a route's name, a NetID (and ``:PORT``), or a name of the plant.
    """

    station: str
    target: Text
    timeout_ms: Annotated[int, Meta(ge=1, le=60_000)] = 5_000


class RoutesImportParameters(Parameters, frozen=True, kw_only=True):
    """``routes_import``: adds the routes of a StaticRoutes file, or says what it would add."""

    station: str
    xml: Annotated[str, Meta(max_length=MAX_XML)]
    dry_run: bool = False


class RoutesExportParameters(Parameters, frozen=True, kw_only=True):
    """``routes_export``: the routes of one station as a StaticRoutes file."""

    station: str


class RoutesScanParameters(Parameters, frozen=True, kw_only=True):
    """``routes_scan``: asks for routers of other hosts, from one station or from all.

    Asks *address*, of a host or a network, or the networks of the stations.
    """

    station: str = ""
    address: Text = ""
    wait_ms: Annotated[int, Meta(ge=10, le=60_000)] = 1_000


class RoutesAddRemoteParameters(Parameters, frozen=True, kw_only=True):
    """``routes_add_remote``: asks the router at *address* for a route to that of *station*.

    User and password are those of the other system; they are sent in clear.
    """

    station: str
    address: Text
    name: Text = ""
    user: Text = ""
    password: Text = ""
    wait_ms: Annotated[int, Meta(ge=10, le=60_000)] = 5_000


class EndpointRow(Document, frozen=True, kw_only=True):
    """One path of packets, and the figures of its requests.

    Attributes:
        transport: Of its packets.
        address: Of the other end.
        requests: That went out by a route, or came in by a connection.
        answers: To them.
        errors: Requests that did not get to their targets.
        octets_out: Of packets that left here.
        octets_in: Of packets that came here.
        last_error: In words, empty while there was none.
    """

    transport: str
    address: str
    requests: int = 0
    answers: int = 0
    errors: int = 0
    octets_out: int = 0
    octets_in: int = 0
    last_error: str = ""


class RouteRow(EndpointRow, frozen=True, kw_only=True):
    """One route: a way to the next hop.

    Attributes:
        name: As people call it.
        net_id: By which it is requested here.
        octets: How many of its octets have to match; 0 for a default route.
        origin: Plant file, its ports, a change at run time, or the station itself.
        state: Whether a request would go on.
        why: What is wrong with one that is down.
        next_name: Name of the router at the next hop.
        rtt_us: Round trip to the next hop; None while it is not known.
        expires_s: In how many seconds it is forgotten; None for never.
        real: The NetID that the station itself has, where *net_id* is a virtual one; else empty.
        unidirectional: Whether requests from there are refused.
        timeout_ms: How long an answer may take; 0 for as long as usual.
        probed: Whether the next hop is probed from time to time.
    """

    name: str
    net_id: str
    octets: int
    origin: OriginName
    state: StateName
    why: str = ""
    next_name: str = ""
    rtt_us: int | None = None
    expires_s: int | None = None
    real: str = ""
    unidirectional: bool = False
    timeout_ms: int = 0
    probed: bool = True

    @property
    def pattern(self) -> str:
        """The NetIDs that it is for, ``5.1.2.3.*.*``; ``default`` for all others."""
        octets = self.net_id.split(".")[: self.octets]
        return ".".join([*octets, *["*"] * (6 - self.octets)]) if self.octets else "default"


class ConnectionRow(EndpointRow, frozen=True, kw_only=True):
    """One connection that requests came by, or one sender where there are none.

    Attributes:
        since_s: For how many seconds it has been used.
        net_ids: Sources of its requests, the first few.
        took_us: How long the latest answer took; None before the first.
    """

    since_s: int
    net_ids: list[str] = field(default_factory=list)
    took_us: int | None = None


class RequestRow(Document, frozen=True, kw_only=True):
    """What became of one packet.

    Attributes:
        at: Wall clock, seconds of Unix time.
        outcome: ``answered``, ``failed``, ``denied``, ``loop``, ``late`` or ``dropped``.
        service: Of ADS; empty where the packet could not be read, as with the next two.
        target: NetID and AMS port.
        source: NetID and AMS port.
        came_by: Address and transport; empty if its connection is gone.
        transport: Of its next hop; empty for a service of this station, and if it did not go on.
        address: That it went on to.
        error: Of the AMS header of its answer.
        took_us: From the request to its answer.
        text: What was wrong; empty if nothing.
    """

    at: float
    outcome: str
    service: str = ""
    target: str = ""
    source: str = ""
    came_by: str = ""
    transport: str = ""
    address: str = ""
    error: int = 0
    took_us: int = 0
    text: str = ""


class InterruptionRow(Document, frozen=True, kw_only=True):
    """Subscriptions of one client at one server to which nothing comes; they are being restored.

    Attributes:
        client: Address and transport of the client.
        source: NetID and AMS port of the client.
        target: NetID and AMS port of the server.
        count: How many subscriptions there are.
        since_s: For how many seconds nothing has come.
        why: What was wrong last.
    """

    client: str
    source: str
    target: str
    count: int
    since_s: int
    why: str


class RouterRow(Document, frozen=True, kw_only=True):
    """The router of one station; *total* routes match, of which *routes* are some."""

    station: str
    net_id: str
    routes: list[RouteRow]
    total: int
    connections: list[ConnectionRow] = field(default_factory=list)
    requests: list[RequestRow] = field(default_factory=list)
    interruptions: list[InterruptionRow] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class TestResult(Document, frozen=True, kw_only=True):
    """What came of a question to a target.

    Attributes:
        target: NetID and AMS port of the request.
        name: Of the route that was taken; empty for none.
        ok: Whether there is a way there and back.
        rtt_us: How long that took; None without an answer.
        state: ADS state, such as ``RUN``; empty if it did not tell.
        error: Of the answer.
        text: All that in words.
        hint: What to do; empty if nothing.
    """

    __test__ = False

    target: str
    name: str
    ok: bool
    rtt_us: int | None = None
    state: str = ""
    error: int = 0
    text: str
    hint: str = ""


class NeighbourRow(Document, frozen=True, kw_only=True):
    """A router of another host that answered.

    Attributes:
        station: Sender of the request.
        name: Of the router or its host.
        net_id: Of the router.
        address: IPv4 address that the answer came from.
        version: Of its software; empty if it does not tell.
        route: Name of the route that leads there; empty for none.
        is_learned: Whether that was learned.
    """

    station: str
    name: str
    net_id: str
    address: str
    version: str
    route: str
    is_learned: bool


class RemoteRouteResult(Document, frozen=True, kw_only=True):
    """Answer of another router to a request to add a route.

    Attributes:
        ok: Whether it has it now.
        result: An ADS result; None if it said nothing.
        text: That in words.
    """

    ok: bool
    result: int | None
    text: str


class ImportRow(Document, frozen=True, kw_only=True):
    """One route of a file, and why it was not added; *reason* is empty if it was."""

    name: str
    net_id: str
    via: str
    reason: str = ""


class Export(Document, frozen=True, kw_only=True):
    """A StaticRoutes file, and the names of routes that it cannot hold."""

    xml: str
    left_out: list[str] = field(default_factory=list)


class RouteAnswer(Document, frozen=True, kw_only=True):
    """Answer to ``routes_remove``."""

    route: RouteRow


class AddedRoute(Document, frozen=True, kw_only=True):
    """Answer to ``routes_add``; *warnings* name what hides the route."""

    route: RouteRow
    warnings: list[str]


class ViaParameters(Parameters, frozen=True, kw_only=True):
    """Base: *via* is the station whose router sends the requests; empty for the first one here."""

    via: str = ""


class ScanParameters(ViaParameters, frozen=True, kw_only=True):
    """``scan``."""


class TraceParameters(ViaParameters, frozen=True, kw_only=True):
    """``trace``: *target* is ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``."""

    target: str


class AskParameters(TraceParameters, frozen=True, kw_only=True):
    """``ams_ask``: one ADS request; *data* is what follows the header, in hexadecimal digits.

    With *device* a station stands for its first EAP port, not for its router.
    """

    command: Annotated[int, Meta(ge=1, le=0xFFFF)]
    data: str = ""
    device: bool = False
    timeout_ms: Annotated[int, Meta(ge=1, le=MAX_TIMEOUT_MS)] = 5000


class SlaveEntry(Document, frozen=True):
    """Slave of a bus port; *state* is None while it is not known."""

    address: int
    name: str
    state: str | None


class ScannedPort(Document, frozen=True):
    """Port of a station, with the slaves of a bus; *error* says why they are not known."""

    name: str
    kind: str
    net_id: str
    interface: str
    slaves: list[SlaveEntry]
    error: str


class StationEntry(Document, frozen=True):
    """Station of the plant; *error* says why it did not answer."""

    name: str
    net_id: str
    ports: list[ScannedPort]
    error: str


class ScanVia(Document, frozen=True):
    """Station that scanned, and the address at which AMS/TCP reaches it."""

    station: str
    address: str


class PlantScan(Document, frozen=True):
    """Answer to ``scan``."""

    stations: list[StationEntry]
    via: ScanVia


class MergedScan(Document, frozen=True):
    """``eapctl scan``: answers of all appliances."""

    stations: list[StationEntry]
    via: list[ScanVia]


class HopRow(Document, frozen=True, kw_only=True):
    """One router on the way to a target; *spent_us* is the part of *took_us* behind the last one.

    *interrupted* is None where an older router does not tell it.
    """

    station: str
    net_id: str
    opaque: bool
    route: str
    transport: str
    address: str
    state: str
    why: str
    interrupted: int | None = None
    interrupted_s: int | None = None
    may: dict[str, bool | None]
    took_us: int
    spent_us: int


class TargetAnswer(Document, frozen=True):
    """Answer of a target to ReadState."""

    error: int
    text: str
    ads_state: int | None
    device_state: int | None
    took_us: int


class TracedPath(Document, frozen=True):
    """Answer to ``trace``; *why* says where the way ends."""

    target: str
    address: str
    name: str
    ok: bool
    why: str
    hops: list[HopRow]
    answer: TargetAnswer | None


class AmsReply(Document, frozen=True):
    """Answer to ``ams_ask``: error of the AMS header, and what follows it."""

    error: int
    data: str


ROUTES_LIST = Method("routes_list", RoutesListParameters, list[RouterRow])
ROUTES_ADD = Method("routes_add", RoutesAddParameters, AddedRoute)
ROUTES_REMOVE = Method("routes_remove", RoutesRemoveParameters, RouteAnswer)
ROUTES_TEST = Method("routes_test", RoutesTestParameters, TestResult)
ROUTES_IMPORT = Method("routes_import", RoutesImportParameters, list[ImportRow])
ROUTES_EXPORT = Method("routes_export", RoutesExportParameters, Export)
ROUTES_SCAN = Method("routes_scan", RoutesScanParameters, list[NeighbourRow])
ROUTES_ADD_REMOTE = Method("routes_add_remote", RoutesAddRemoteParameters, RemoteRouteResult)
SCAN = Method("scan", ScanParameters, PlantScan)
TRACE = Method("trace", TraceParameters, TracedPath)
AMS_ASK = Method("ams_ask", AskParameters, AmsReply)


def hop_row(report: HopReport, took_us: int, spent_us: int, *, is_opaque: bool) -> HopRow:
    """Return one router of a way."""
    return HopRow(
        station=report.station,
        net_id=report.net_id,
        opaque=is_opaque,
        route=report.route,
        transport=report.transport,
        address=report.address,
        state=report.state,
        why=report.why,
        interrupted=report.interrupted,
        interrupted_s=report.interrupted_s,
        may={str(service): allowed for service, allowed in report.may.items()},
        took_us=took_us,
        spent_us=spent_us,
    )


def interruption_text(row: InterruptionRow) -> str:
    """Return in words what is interrupted."""
    noun = "subscription is" if row.count == 1 else "subscriptions are"
    return (
        f"{row.count} {noun} interrupted, of {row.source} ({row.client}) at {row.target}: {row.why}"
    )
