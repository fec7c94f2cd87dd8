"""Reports on routes and connections: state, figures, last error, advice, and the hops of a trace.

The hop report is an own format, served at the router's NetID and AMS port 10000: a ReadWrite of the
index group ROUTE_QUERY with a :class:`HopQuestion` is answered with a :class:`HopReport` in JSON.
A question with *further* is forwarded: the next router is asked in the name of this one, the only
one that it knows.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import msgspec

from eap.ams.hop_prober import HopProber
from eap.ams.record import Traffic
from eap.ams.routes import Route
from eap.ams.spec import AccessService, TransportKind
from eap.codec.ads import AdsError
from eap.codec.wire import WireStruct, net_id, u8, u16
from eap.errors import MalformedError
from eap.ids import Endpoint, NetId


class RouteState(StrEnum):
    """State of a route."""

    UP = "up"
    DOWN = "down"
    UNKNOWN = "unknown"
    """Nothing speaks against it, and nothing was answered yet."""
    CLIENT = "client"
    """A client requested it by "add route", and does not listen: it has its own connections."""


class Obstacle(NamedTuple):
    """Reason why nothing can go by a route now, and the *state* that this makes of it."""

    state: RouteState
    why: str

    def __str__(self) -> str:
        if self.state is RouteState.CLIENT:
            return f"is a client, {self.why}"
        return f"is {self.state}: {self.why}"


class RouteReport(NamedTuple):
    """One route.

    *why* says what is wrong with one that is down.  *round_trip_ns* is that of its next hop, and
    None while that is not known.  *next_name* is the name of the router at that hop.
    """

    route: Route
    state: RouteState
    why: str
    round_trip_ns: int | None
    traffic: Traffic
    next_name: str


class ConnectionReport(NamedTuple):
    """Traffic of one client connection."""

    endpoint: Endpoint
    traffic: Traffic


class Location(NamedTuple):
    """Route of a request.

    *route* is None if it is for this station, or if there is none; *why* says why it would fail.
    *may* is what access rules let the client do, None if that depends on the object.
    """

    is_here: bool
    route: RouteReport | None
    why: str
    may: dict[AccessService, bool | None]
    interrupted: int = 0
    """Subscriptions to ports of the NetID to which nothing comes."""
    interrupted_at_ns: int | None = None


def report_route(
    route: Route, obstacle: Obstacle | None, traffic: Traffic | None, hop_prober: HopProber | None,
    *,
    next_name: str,
) -> RouteReport:  # fmt: skip
    """Return the report of a route.

    Args:
        route: The route.
        obstacle: Reason why nothing can go there; None if something can.
        traffic: By the route so far; None for none.
        hop_prober: Of its router, if that has one.
        next_name: Name of the router at the next hop.
    """
    known = traffic or Traffic()
    round_trip_ns = None if hop_prober is None else hop_prober.round_trip_ns(route.hop)
    if obstacle is not None:
        return RouteReport(route, obstacle.state, obstacle.why, None, known, next_name)
    # A probe measures the hop alone, a request also the service behind it.
    if round_trip_ns is None and known.answers:
        round_trip_ns = known.round_trip_ns
    is_up = known.is_answered or (hop_prober is not None and hop_prober.has_answered(route.hop))
    state = RouteState.UP if is_up else RouteState.UNKNOWN
    return RouteReport(route, state, "", round_trip_ns, known, next_name)


_ALIVE = frozenset({AdsError.TARGET_PORT})
"""Errors of the AMS header that only the owner of the NetID sends."""
_UNREACHED: dict[str, str] = {
    TransportKind.AMS_TCP: (
        "see whether it is switched on, and listens on that TCP port (a firewall?)"
    ),
    TransportKind.AMS_TLS: (
        "see whether it is switched on, has Secure ADS (a firewall?), and trusts the certificate of"
        " this station"
    ),
    TransportKind.UDP: "see whether it is switched on, in the same network, and its station runs",
    TransportKind.TCP: "see whether its station runs, and takes connections on that port",
    TransportKind.ETHERNET: "see to the cable and the MAC address, and whether its station runs",
    TransportKind.MQTT: (
        "see whether both stations are connected to the broker, under the same network"
    ),
}
"""Advice on a hop that is down, by the kind of its transport."""
_CLIENT = "nothing is wrong if it only asks; to be asked, it has to listen there"


class Advice(NamedTuple):
    """Result of a request to another station, with a hint."""

    is_reached: bool
    text: str
    hint: str = ""


def advise(
    error: int, target: NetId, route: RouteReport | None, own: NetId, *, is_own: bool
) -> Advice:
    """Return the meaning of the *error* in an AMS header.

    Args:
        error: 0 for none.
        target: Of the request.
        route: That was taken; None for none.
        own: NetID of the router that sent the request.
        is_own: Whether *target* is of its station.
    """
    if not error:
        return Advice(is_reached=True, text="answers")
    words = AdsError.words_of(error)
    # Before all else: an error that only the target sends proves the whole path.
    if error in _ALIVE:
        return Advice(is_reached=True, text=f"is there; {words}")
    if is_own:
        return Advice(is_reached=False, text=f"this station itself answers: {words}")
    if route is None:
        return Advice(
            is_reached=False,
            text=f"there is no route to {target}",
            hint="add one: 'eapctl routes add', or under routes in the plant file",
        )
    return _advise_on_route(error, words, target, route, own)


def _advise_on_route(
    error: int, words: str, target: NetId, report: RouteReport, own: NetId
) -> Advice:
    """Return the fault of a route, or of a hop behind it."""
    hop = report.route.hop
    where = f"{report.next_name} ({hop})"
    if report.state in {RouteState.DOWN, RouteState.CLIENT}:
        hint = _CLIENT if report.state is RouteState.CLIENT else _UNREACHED.get(hop.kind, "")
        obstacle = Obstacle(report.state, report.why)
        return Advice(is_reached=False, text=f"{where} {obstacle}", hint=hint)
    if error == AdsError.TIMEOUT:
        hint = (
            f"it may be overloaded, or answer only whom it has a route to, as TwinCAT does: there,"
            f" add one to {own} at the address of this host"
        )
        return Advice(is_reached=False, text=f"no answer from {where} in time", hint=hint)
    if error == AdsError.TARGET_MACHINE:
        hint = f"the router there needs a route to {target}, or it is not the NetID that is meant"
        return Advice(is_reached=False, text=f"{where} has no route to {target}", hint=hint)
    if error == AdsError.HOST_UNREACHABLE:
        hint = "'eapctl trace' names the hop and the cause"
        return Advice(is_reached=False, text=f"host unreachable behind {where}", hint=hint)
    if error == AdsError.ACCESS_DENIED:
        hint = "allow it under access in the plant file, of this station or of one on the way"
        return Advice(is_reached=False, text="access rules forbid to ask for its state", hint=hint)
    return Advice(is_reached=False, text=f"{where} or a station behind it answers: {words}")


MAX_FURTHER = 16
"""Routers that a question is forwarded to; a longer path is an error."""
MAX_REPORT = 4096
"""Bytes."""


class HopQuestion(WireStruct, frozen=True):
    """Query for the route to an address, at the router that is *further* hops away.

    *wants_faults* is 1 for the faults of a slave, too, which take longer: the time of the answer is
    not that of the path then.
    """

    target: net_id
    port: u16
    further: u8 = 0
    wants_faults: u8 = 0


class HopReport(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer of one router to a route query.

    Attributes:
        station: Its name.
        net_id: Its NetID.
        is_here: Whether the address is one of its own station.
        route: Name of the route that it has; empty if none.
        next_net_id: NetID of the router at the other end of it, as this one knows it; empty if it
            does not know that.
        next_name: Name of that router, as this one knows it.
        transport: By which packets leave.
        address: That they go to.
        target: NetID of the target over there.
        state: Of the route: ``up``, ``down`` or ``unknown``.
        why: Reason it forwards nothing; empty if it does.
        may: Rights of the client by access rules; null if they depend on the object.
        interrupted: How many subscriptions to the NetID it is restoring.
        interrupted_s: For how many seconds; None for none.
        last_failure: Reason of the latest failed request of the sender to the target, if that is
            here.
        faults: Present faults of the target, if it is a slave here, and of its bus; on request.
        error: Of ADS, why the next router did not answer; 0 for none.
    """

    station: str
    net_id: str
    is_here: bool = False
    route: str = ""
    next_net_id: str = ""
    next_name: str = ""
    transport: str = msgspec.field(name="door", default="")
    address: str = ""
    target: str = ""
    state: str = ""
    why: str = ""
    may: dict[AccessService, bool | None] = {}
    error: int = 0
    interrupted: int = 0
    interrupted_s: int | None = None
    last_failure: str = ""
    faults: tuple[str, ...] = ()


def report_of(
    station: str, net_id: NetId, target: NetId, location: Location, now_ns: int
) -> HopReport:
    """Return the report of the router of *station* on *target*, which it found at *location*."""
    found, since_ns = location.route, location.interrupted_at_ns
    report = HopReport(
        station=station, net_id=str(net_id), is_here=location.is_here, why=location.why,
        may=location.may, interrupted=location.interrupted,
        interrupted_s=None if since_ns is None else (now_ns - since_ns) // 1_000_000_000,
    )  # fmt: skip
    if found is None:
        return report
    route, next_router = found.route, found.route.next_router
    return msgspec.structs.replace(
        report,
        route=route.name,
        next_net_id="" if next_router is None else str(next_router),
        next_name=found.next_name,
        transport=route.hop.transport,
        address=route.hop.connection,
        target=str(route.to_real(target)),
        state=found.state,
    )


_DECODER = msgspec.json.Decoder(HopReport)


def encode_report(report: HopReport) -> bytes:
    """Return the data of an answer."""
    return msgspec.json.encode(report)


def decode_report(data: bytes) -> HopReport:
    """Read the data of an answer; raise MalformedError if it is none."""
    try:
        report = _DECODER.decode(data)
        for net_id in (report.net_id, report.next_net_id, report.target):
            NetId.parse(net_id or report.net_id)
        _require_printable(report)
    except (ValueError, RecursionError) as exc:
        raise MalformedError(f"not a report of a hop: {exc}", layout="HopReport") from None
    return report


def _require_printable(report: HopReport) -> None:
    """Raise ValueError for a text that would do something to a terminal."""
    texts = (report.station, report.route, report.next_name, report.transport, report.address)
    for text in (*texts, report.why, report.last_failure, *report.faults):
        if not text.isprintable():
            raise ValueError(f"{text!r} cannot be printed")
