"""What a router says of the way to an address: the question and the answer of a trace.

Own format, behind the router's NetID and AMS port 10000: a ReadWrite of the group WHEREABOUTS with
a :class:`HopQuestion` is answered with a :class:`HopReport` in JSON.  A question with *further* is
handed on: the next router is asked in the name of this one, which alone knows it.
"""

from __future__ import annotations

import msgspec

from eap.ams.report import Location
from eap.ams.spec import AccessService
from eap.codec.wire import WireStruct, net_id, u8, u16
from eap.errors import MalformedError
from eap.ids import NetId

MAX_FURTHER = 16
"""Routers that a question is handed on to; more are no way that anybody means."""
MAX_REPORT = 4096
"""Octets."""


class HopQuestion(WireStruct, frozen=True):
    """Where do requests for this address go?  *further*: how many routers further on that is."""

    target: net_id
    port: u16
    further: u8 = 0
    reserved: u8 = 0


class HopReport(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What one router says.

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
        why: Why it passes nothing on; empty if it does.
        may: What access rules let the asker do: true, false, or null if that depends on the object.
        interrupted: How many subscriptions to the NetID it is restoring.
        interrupted_s: For how many seconds; None for none.
        error: Of ADS, why the router that was asked next did not answer; 0 if there was none.
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


def report_of(
    station: str, net_id: NetId, target: NetId, location: Location, now_ns: int
) -> HopReport:
    """Return what the router of *station* says of *target*, for which it found *location*."""
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
    except (msgspec.DecodeError, UnicodeDecodeError, ValueError) as exc:
        raise MalformedError(f"not a report of a hop: {exc}", layout="HopReport") from None
    return report


def _require_printable(report: HopReport) -> None:
    """Raise ValueError for a text that would do something to a terminal."""
    texts = (report.station, report.route, report.next_name, report.transport, report.address)
    for text in (*texts, report.why):
        if not text.isprintable():
            raise ValueError(f"{text!r} cannot be printed")
