"""The control protocol's words about routes; docs/control.md is their description.

What is told are records too: the server fills them in, the command line and the terminal's view
read them, so that they cannot disagree about a field.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import msgspec
from msgspec import Meta

from eap.appliance.control import ErrorCode, Parameters
from eap.errors import ControlError

PAGE = 1000
"""Routes of an answer, unless it was asked for fewer."""
MAX_XML = 1 << 20
"""Characters of a file with routes."""
MAX_TEXT = 255

Text: TypeAlias = Annotated[str, Meta(max_length=MAX_TEXT)]
OriginName: TypeAlias = Literal["static", "derived", "added", "learned"]
StateName: TypeAlias = Literal["up", "down", "unknown", "client"]


class RoutesListParameters(Parameters, frozen=True, kw_only=True):
    """``routes_list``: of one station, or of all.

    Of each station *count* routes from number *first* on, of those that have *match* in their name,
    NetID, door, address, origin or state; and the latest *requests*.
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
        via: Where packets go: ``STATION/PORT`` of the plant, or the kind of a door and an address,
            such as ``ams-tcp:192.168.1.5``, ``udp:10.0.0.5``, ``mqtt:NETWORK``.
        port: EAP port that they leave by; empty for the first that can.
        octets: How many octets of a NetID have to be those of *net_id*; 0 for a default route.
        virtual: NetID by which the station is known here; empty for its own.
        unidirectional: Whether nothing may be asked from there.
        timeout_ms: How long an answer may take; 0 for as long as usual.
        probed: Whether the next hop is asked from time to time whether it is alive.
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
    """``routes_remove``: by name or NetID; *door* and *address* choose where several have it."""

    station: str
    route: Text
    door: Text = ""
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


class RoutesIntroduceParameters(Parameters, frozen=True, kw_only=True):
    """``routes_introduce``: asks the router at *address* for a route to that of *station*.

    User and password are those of the other system; they are sent in clear.
    """

    station: str
    address: Text
    name: Text = ""
    user: Text = ""
    password: Text = ""
    wait_ms: Annotated[int, Meta(ge=10, le=60_000)] = 5_000


class Document(msgspec.Struct, frozen=True, kw_only=True):
    """Base of what is told; a field that somebody newer tells is not looked at."""


class WayRow(Document, frozen=True, kw_only=True):
    """One way of packets, and what was asked by it.

    Attributes:
        door: That packets come and go by.
        address: Of the other end.
        requests: That went out by a route, or came in by a connection.
        answers: To them.
        errors: Requests that did not get to their targets.
        octets_out: Of packets that left here.
        octets_in: Of packets that came here.
        last_error: In words, empty while there was none.
    """

    door: str
    address: str
    requests: int = 0
    answers: int = 0
    errors: int = 0
    octets_out: int = 0
    octets_in: int = 0
    last_error: str = ""


class RouteRow(WayRow, frozen=True, kw_only=True):
    """One route: a way to the next hop.

    Attributes:
        name: As people call it.
        net_id: As it is asked for here.
        octets: How many of its octets have to match; 0 for a default route.
        origin: Who says so: the plant file, its ports, somebody at run time, the station itself.
        state: Whether a request would go on.
        why: What is wrong with one that is down.
        next_name: Name of the router at the next hop.
        rtt_us: Round trip to the next hop; None while it is not known.
        expires_s: In how many seconds it is forgotten; None for never.
        real: The NetID that the station itself has, where *net_id* is a virtual one; else empty.
        unidirectional: Whether nothing may be asked from there.
        timeout_ms: How long an answer may take; 0 for as long as usual.
        probed: Whether the next hop is asked from time to time.
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


class ConnectionRow(WayRow, frozen=True, kw_only=True):
    """One connection that requests came by, or one sender where there are none.

    Attributes:
        since_s: For how many seconds it has been used.
        net_ids: That asked by it, the first few.
        took_us: How long the latest answer took; None before the first.
    """

    since_s: int
    net_ids: list[str] = []
    took_us: int | None = None


class RequestRow(Document, frozen=True, kw_only=True):
    """What became of one packet.

    Attributes:
        at: Wall clock, seconds of Unix time.
        outcome: ``answered``, ``failed``, ``denied``, ``loop``, ``late`` or ``dropped``.
        service: Of ADS; empty where the packet could not be read, as with the next two.
        target: NetID and AMS port.
        source: NetID and AMS port.
        came_by: Address and door; empty if its connection is gone.
        door: By which it went on; empty for a service of this station, and if it did not.
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
    door: str = ""
    address: str = ""
    error: int = 0
    took_us: int = 0
    text: str = ""


class InterruptionRow(Document, frozen=True, kw_only=True):
    """Subscriptions of one client at one server to which nothing comes; they are being restored.

    Attributes:
        client: Address and door of the client.
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
    connections: list[ConnectionRow] = []
    requests: list[RequestRow] = []
    interruptions: list[InterruptionRow] = []
    warnings: list[str] = []


class TestResult(Document, frozen=True, kw_only=True):
    """What came of a question to a target.

    Attributes:
        target: NetID and AMS port that were asked.
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
        station: That asked.
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


class IntroducedRow(Document, frozen=True, kw_only=True):
    """What another router said when it was asked for a route.

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
    left_out: list[str] = []


DocumentT = TypeVar("DocumentT")


def read_document(document: Any, kind: type[DocumentT]) -> DocumentT:
    """Return a result as a record; raise ControlError if it is none."""
    try:
        return msgspec.convert(document, kind)
    except msgspec.ValidationError as exc:
        raise ControlError(f"the answer: {exc}", code=ErrorCode.BAD_REQUEST) from None


def interruption_text(row: InterruptionRow) -> str:
    """Return in words what is interrupted."""
    noun = "subscription is" if row.count == 1 else "subscriptions are"
    return (
        f"{row.count} {noun} interrupted, of {row.source} ({row.client}) at {row.target}: {row.why}"
    )
