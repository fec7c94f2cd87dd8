"""Control protocol: routes, and AMS requests through a router.

Server and client share these records of requests and answers; docs/control.md describes them.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, field

from eap.ams.report import HopReport
from eap.control.protocol import Document, Method, Parameters, WriteOrigin

PAGE = 1000
"""Limit of the routes in one answer."""
MAX_XML = 1 << 20
"""Limit of the characters of a file with routes."""
MAX_TEXT = 255
MAX_TIMEOUT_MS = 60_000

Text: TypeAlias = Annotated[str, Meta(max_length=MAX_TEXT)]
OriginName: TypeAlias = Literal["static", "derived", "added", "learned"]
StateName: TypeAlias = Literal["up", "down", "unknown", "client"]


class RoutesListParameters(Parameters, frozen=True, kw_only=True):
    """``routes_list``: routes of one station, or of all.

    Each station answers with *count* routes from number *first* on, of those that have *match* in
    their name, NetID, transport, address, origin or state, and with the latest *requests*.
    """

    station: str = ""
    match: Text = ""
    first: Annotated[int, Meta(ge=0)] = 0
    count: Annotated[int, Meta(ge=0, le=PAGE)] = PAGE
    requests: Annotated[int, Meta(ge=0, le=256)] = 50


class RoutesAddParameters(Parameters, frozen=True, kw_only=True):
    """``routes_add``: adds a route, which is stored until it is removed.

    Attributes:
        station: Station whose router gets the route.
        name: Name for people.
        net_id: NetID of the target; empty if *name* is a station of the plant.
        via: Next hop: ``STATION/PORT`` of the plant, or a kind of transport and an address, such as
            ``ams-tcp:192.168.1.5``, ``ams-tls:plc.hall``, ``udp:10.0.0.5``, ``mqtt:NETWORK``.
        port: Local EAP port of the transport; empty for the first that fits.
        octets: Number of bytes of *net_id* that must match; 0 for a default route.
        virtual: NetID of the target in requests; empty for its own.
        unidirectional: Whether requests from the target are denied.
        timeout_ms: Time limit of an answer; 0 for the default.
        probed: Whether the next hop is probed from time to time.
        replaces: Name or NetID of an added route that this one replaces; empty for none.
        fingerprint: By Secure ADS: SHA-256 of the certificate of the next hop; empty if an
            authority of the station signed it.
        check_name: Whether such a certificate has to name the host of *via*.
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
    fingerprint: Text = ""
    check_name: bool = True


class RoutesRemoveParameters(Parameters, frozen=True, kw_only=True):
    """``routes_remove``: by name or NetID; *transport* and *address* select one of several."""

    station: str
    route: Text
    transport: Text = ""
    address: Text = ""


class RoutesTestParameters(Parameters, frozen=True, kw_only=True):
    """``routes_test``: reads the state of *target*.

    It is a route's name, a NetID (and ``:PORT``), or a name of the plant.
    """

    station: str
    target: Text
    timeout_ms: Annotated[int, Meta(ge=1, le=60_000)] = 5_000


class RoutesImportParameters(Parameters, frozen=True, kw_only=True):
    """``routes_import``: adds the routes of a StaticRoutes file; a dry run only checks them."""

    station: str
    xml: Annotated[str, Meta(max_length=MAX_XML)]
    dry_run: bool = False


class RoutesExportParameters(Parameters, frozen=True, kw_only=True):
    """``routes_export``: the routes of one station as a StaticRoutes file."""

    station: str


class RoutesScanParameters(Parameters, frozen=True, kw_only=True):
    """``routes_scan``: scans for routers of other hosts, from one station or from all.

    The scan goes to *address*, a host or a network, or to the networks of the stations.
    """

    station: str = ""
    address: Text = ""
    wait_ms: Annotated[int, Meta(ge=10, le=60_000)] = 1_000


class RoutesAddRemoteParameters(Parameters, frozen=True, kw_only=True):
    """``routes_add_remote``: requests a route to *station* at the router of *address*.

    User and password are those of the other system.  By UDP 48899 they are sent in clear text, with
    *tls* by Secure ADS, to a router whose certificate has *fingerprint*, or is signed by an
    authority of the station.
    """

    station: str
    address: Text
    name: Text = ""
    user: Text = ""
    password: Text = ""
    wait_ms: Annotated[int, Meta(ge=10, le=60_000)] = 5_000
    tls: bool = False
    fingerprint: Text = ""


# A base of two records: both show the same columns, whoever opened the path.
class EndpointRow(Document, frozen=True, kw_only=True):
    """One path of packets, and the figures of its requests.

    Attributes:
        transport: Transport of its packets.
        address: Address of the other end.
        requests: Requests sent by a route, or received by a connection.
        answers: Their answers.
        errors: Requests that did not reach their targets.
        octets_out: Bytes sent.
        octets_in: Bytes received.
        last_error: Latest error in words, empty without one.
        last_error_s: Its age; None without one.
    """

    transport: str
    address: str
    requests: int = 0
    answers: int = 0
    errors: int = 0
    octets_out: int = 0
    octets_in: int = 0
    last_error: str = ""
    last_error_s: int | None = None


class RouteRow(EndpointRow, frozen=True, kw_only=True):
    """One route with its next hop.

    Attributes:
        name: Name for people.
        net_id: NetID of the target in requests.
        octets: Number of its bytes that must match; 0 for a default route.
        origin: Plant file, its ports, a change at run time, or a scan.
        state: Whether a request would be forwarded.
        why: Reason for state ``down``.
        next_name: Name of the router at the next hop.
        rtt_us: Round trip to the next hop; None while it is unknown.
        expires_s: Remaining lifetime; None without a limit.
        real: NetID that the target has itself, where *net_id* is a virtual one; else empty.
        unidirectional: Whether requests from the target are denied.
        timeout_ms: Time limit of an answer; 0 for the default.
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
        """NetIDs that match, such as ``5.1.2.3.*.*``; ``default`` for all."""
        # Only the bytes that are compared are shown: the others may be any.
        octets = self.net_id.split(".")[: self.octets]
        return ".".join([*octets, *["*"] * (6 - self.octets)]) if self.octets else "default"


class ConnectionRow(EndpointRow, frozen=True, kw_only=True):
    """One connection that requests came by, or one sender of datagrams.

    Attributes:
        since_s: Age of the connection.
        net_ids: Sources of its requests, the first few.
        took_us: Time of the latest answer; None before the first.
    """

    since_s: int
    net_ids: list[str] = field(default_factory=list)
    took_us: int | None = None


class RequestRow(Document, frozen=True, kw_only=True):
    """Outcome of one packet.

    Attributes:
        at: Wall clock, seconds of Unix time.
        outcome: ``answered``, ``failed``, ``denied``, ``loop``, ``late`` or ``dropped``.
        service: ADS service; empty for an invalid packet, as with the next two.
        target: NetID and AMS port.
        source: NetID and AMS port.
        came_by: Address and transport; empty if its connection is closed.
        transport: Transport of its next hop; empty for a local service, or if it was not forwarded.
        address: Address of its next hop.
        error: Error code in the AMS header of its answer.
        took_us: Time from the request to its answer.
        text: Reason of a failure; empty otherwise.
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
    """Interrupted subscriptions of one client at one server, which are being restored.

    Attributes:
        client: Address and transport of the client.
        source: NetID and AMS port of the client.
        target: NetID and AMS port of the server.
        count: Number of subscriptions.
        since_s: Duration of the interruption.
        why: Latest reason.
    """

    client: str
    source: str
    target: str
    count: int
    since_s: int
    why: str


class RouterRow(Document, frozen=True, kw_only=True):
    """Router of one station; *total* routes match, of which *routes* are one page."""

    station: str
    net_id: str
    routes: list[RouteRow]
    total: int
    connections: list[ConnectionRow] = field(default_factory=list)
    requests: list[RequestRow] = field(default_factory=list)
    interruptions: list[InterruptionRow] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class TestResult(Document, frozen=True, kw_only=True):
    """Result of a request to a target.

    Attributes:
        target: NetID and AMS port of the request.
        name: Name of the matching route; empty for none.
        ok: Whether the target answered.
        rtt_us: Round trip; None without an answer.
        state: ADS state, such as ``RUN``; empty if it is unknown.
        error: Error code of the answer.
        text: Result in words.
        hint: Remedy; empty for none.
    """

    # pytest takes classes whose names begin with Test for tests.
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
    """Router of another host that answered.

    Attributes:
        station: Sender of the request.
        name: Name of the router or its host.
        net_id: NetID of the router.
        address: IPv4 source address of the answer.
        version: Version of its software; empty if it sends none.
        route: Name of the route to it; empty for none.
        is_learned: Whether this scan learned that route.
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
        ok: Whether it has the route now.
        result: An ADS result; None without answer.
        text: Result in words.
    """

    ok: bool
    result: int | None
    text: str


class ImportRow(Document, frozen=True, kw_only=True):
    """One route or broker of a file; *reason* is empty if it was added.

    *note* names what the file has beside, such as flags that are kept without effect.
    """

    name: str
    net_id: str
    via: str
    reason: str = ""
    note: str = ""


class Export(Document, frozen=True, kw_only=True):
    """StaticRoutes file, and the names of the routes that it cannot hold."""

    xml: str
    left_out: list[str] = field(default_factory=list)


class RouteAnswer(Document, frozen=True, kw_only=True):
    """Answer to ``routes_remove``."""

    route: RouteRow


class AddedRoute(Document, frozen=True, kw_only=True):
    """Answer to ``routes_add``; *warnings* name routes that hide the new one."""

    route: RouteRow
    warnings: list[str]


class ViaParameters(Parameters, frozen=True, kw_only=True):
    """Base of requests through a router; *via* is its station, empty for the first local one."""

    via: str = ""


class ScanParameters(ViaParameters, frozen=True, kw_only=True):
    """``scan``."""


class TraceParameters(ViaParameters, frozen=True, kw_only=True):
    """``trace``: *target* is ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``."""

    target: str


class AskParameters(TraceParameters, frozen=True, kw_only=True):
    """``ams_ask``: one ADS request; *data* follows the header, in hexadecimal digits.

    With *device* a station name is the address of its first EAP port, not that of its router.
    *origin* is the author, if a program asks for a user.
    """

    command: Annotated[int, Meta(ge=1, le=0xFFFF)]
    data: str = ""
    device: bool = False
    timeout_ms: Annotated[int, Meta(ge=1, le=MAX_TIMEOUT_MS)] = 5000
    origin: WriteOrigin | None = None


class SlaveEntry(Document, frozen=True):
    """Slave of a bus port; *state* is None while it is unknown."""

    address: int
    name: str
    state: str | None


class ScannedPort(Document, frozen=True):
    """Port of a station, with the slaves of a bus; *error* is the reason if these are unknown."""

    name: str
    kind: str
    net_id: str
    interface: str
    slaves: list[SlaveEntry]
    error: str


class StationEntry(Document, frozen=True):
    """Station of the plant; *error* is the reason of a missing answer."""

    name: str
    net_id: str
    ports: list[ScannedPort]
    error: str


class ScanVia(Document, frozen=True):
    """Station that scanned, and its AMS/TCP address."""

    station: str
    address: str


class PlantScan(Document, frozen=True):
    """Answer to ``scan``."""

    stations: list[StationEntry]
    via: ScanVia


class MergedScan(Document, frozen=True):
    """Output of ``eapctl scan``: answers of all appliances."""

    stations: list[StationEntry]
    via: list[ScanVia]


class HopRow(Document, frozen=True, kw_only=True):
    """One router on the path to a target.

    *spent_us* is the part of *took_us* behind the previous router.  *interrupted* is None if an
    older router does not report it.  *faults* are those of a slave behind the last router, and of
    its bus.
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
    faults: list[str] = field(default_factory=list)


class TargetAnswer(Document, frozen=True):
    """Answer of a target to ReadState."""

    error: int
    text: str
    ads_state: int | None
    device_state: int | None
    took_us: int


class TracedPath(Document, frozen=True):
    """Answer to ``trace``; *why* is the reason if the path ends before the target."""

    target: str
    address: str
    name: str
    ok: bool
    why: str
    hops: list[HopRow]
    answer: TargetAnswer | None


class AmsReply(Document, frozen=True):
    """Answer to ``ams_ask``: error code of the AMS header, and the data that follows it."""

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
    """Return the record of one router on a path."""
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
        # JSON has only texts as names.
        may={str(service): allowed for service, allowed in report.may.items()},
        took_us=took_us,
        spent_us=spent_us,
        faults=list(report.faults),
    )


def interruption_text(row: InterruptionRow) -> str:
    """Return the interruption in words."""
    noun = "subscription is" if row.count == 1 else "subscriptions are"
    return (
        f"{row.count} {noun} interrupted, of {row.source} ({row.client}) at {row.target}: {row.why}"
    )
