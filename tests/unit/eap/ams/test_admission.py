from __future__ import annotations

import pytest

from eap.ams.error_reply import RoutingError
from eap.ams.inflight import Admission, InFlight, Pending, RouterLimits
from eap.ams.record import Outcome
from eap.ams.routes import Route, RouteTable
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, NetId

OWN, FAR, CLIENT = (NetId.parse(text) for text in ("5.1.1.1.1.1", "6.1.1.1.1.1", "7.1.1.1.1.1"))
ASKED = AmsHeader(FAR, 1, CLIENT, 2, 2, invoke_id=9)
TCP, SEGMENT = Endpoint("tcp", "1"), Endpoint("segment", "1")
DOORS = {"tcp": Transport("tcp", is_stream=True, is_hub=True), "segment": Transport("segment")}


def make(hop: Endpoint = TCP, **more: object) -> tuple[Admission, InFlight, Route]:
    route = Route(FAR, "far", hop, **more)
    waiting = InFlight()
    return Admission(OWN, RouteTable([route]), DOORS, waiting, RouterLimits(2, 1)), waiting, route


@pytest.mark.parametrize(
    ("hop", "endpoint", "error"),
    [
        (TCP, Endpoint("tcp", "2"), None),
        (TCP, TCP, AdsError.TARGET_MACHINE),
        (SEGMENT, TCP, None),
        (SEGMENT, Endpoint("segment", "2"), AdsError.TARGET_MACHINE),
        (Endpoint("door that is gone", "1"), TCP, AdsError.HOST_UNREACHABLE),
    ],
)
def test_admission_refuses_route_back_to_source(
    hop: Endpoint, endpoint: Endpoint, error: AdsError | None
) -> None:
    admission, _, route = make(hop)
    found = admission.find_route(ASKED, endpoint)
    assert (
        found == route
        if error is None
        else isinstance(found, RoutingError) and found.error == error
    )


def test_hops_go_down_and_up() -> None:
    admission, _, route = make()
    endpoint = Endpoint("tcp", "2")
    for address in ("1", None):
        admission.hop_down("tcp", address, "cut")
        assert admission.is_down(TCP)
        assert admission.why_down(TCP) == "cut"
        refusal = admission.find_route(ASKED, endpoint)
        assert refusal == RoutingError(
            AdsError.HOST_UNREACHABLE, "far (1 by tcp) is down: cut", route
        )
        admission.hop_up("tcp", address)
        assert admission.find_route(ASKED, endpoint) == route
    admission.hop_down("tcp", "3", "cut")
    assert not admission.is_down(TCP)
    assert admission.why_down(TCP) == ""
    assert admission.why_down(Endpoint("gone", "1")) == "this station has no transport gone"


def test_admission_finds_loop_by_addresses_and_command() -> None:
    admission, waiting, route = make()
    assert admission.find_loop(ASKED, b"addresses", route) is None
    waiting.add(Pending(9, ASKED, TCP, route, b"addresses", 0, 1))
    found = admission.find_loop(ASKED, b"addresses", route)
    assert found is not None
    assert (found.error, found.outcome) == (AdsError.TARGET_MACHINE, Outcome.LOOP)
    assert admission.find_loop(ASKED, b"others", route) is None
    write = AmsHeader(FAR, 1, CLIENT, 2, 3, invoke_id=9)
    assert admission.find_loop(write, b"addresses", route) is None
    waiting.pop(9)
    waiting.add(Pending(9, ASKED, TCP, None, b"addresses", 0, 1))
    assert admission.find_loop(ASKED, b"addresses", route) is None


def test_admission_checks_duplicates_on_datagram_transports_only() -> None:
    admission, waiting, route = make()
    for number, endpoint in enumerate((TCP, SEGMENT)):
        waiting.add(Pending(number, ASKED, endpoint, route, b"addresses", 0, 1, may_repeat=True))
    assert admission.is_duplicate(ASKED, b"addresses", SEGMENT)
    assert not admission.is_duplicate(ASKED, b"addresses", TCP)


def test_admission_limits_requests_by_connection_and_total() -> None:
    admission, waiting, route = make()
    assert admission.check_limits(TCP) is None
    waiting.add(Pending(1, ASKED, TCP, route, b"", 0, 1))
    refusal = admission.check_limits(TCP)
    assert refusal is not None
    assert refusal.error is AdsError.MAILBOX_FULL
    assert admission.check_limits(SEGMENT) is None
    waiting.add(Pending(2, ASKED, SEGMENT, route, b"", 0, 1))
    other = Endpoint("tcp", "3")
    assert admission.check_limits(other) is not None
    waiting.abandon(TCP)
    assert admission.check_limits(other) is None
    assert len(waiting) == 1
