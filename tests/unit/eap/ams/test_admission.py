from __future__ import annotations

import pytest

from eap.ams.action import Outcome
from eap.ams.admission import Judge, Limits
from eap.ams.endpoint import Door, Way
from eap.ams.error_reply import Refusal
from eap.ams.inflight import InFlight, Pending
from eap.ams.routes import Route, RouteTable
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.ids import NetId

OWN, FAR, CLIENT = (NetId.parse(text) for text in ("5.1.1.1.1.1", "6.1.1.1.1.1", "7.1.1.1.1.1"))
ASKED = AmsHeader(FAR, 1, CLIENT, 2, 2, invoke_id=9)
TCP, SEGMENT = Way("tcp", "1"), Way("segment", "1")
DOORS = {"tcp": Door("tcp", is_stream=True, is_hub=True), "segment": Door("segment")}


def make(hop: Way = TCP, **more: object) -> tuple[Judge, InFlight, Route]:
    route = Route(FAR, "far", hop, **more)
    waiting = InFlight()
    return Judge(OWN, RouteTable([route]), DOORS, waiting, Limits(2, 1)), waiting, route


@pytest.mark.parametrize(
    ("hop", "way", "error"),
    [
        (TCP, Way("tcp", "2"), None),
        (TCP, TCP, AdsError.TARGET_MACHINE),
        (SEGMENT, TCP, None),
        (SEGMENT, Way("segment", "2"), AdsError.TARGET_MACHINE),
        (Way("door that is gone", "1"), TCP, AdsError.HOST_UNREACHABLE),
    ],
)
def test_way_back_is_no_way(hop: Way, way: Way, error: AdsError | None) -> None:
    judge, _, route = make(hop)
    found = judge.find_route(ASKED, way)
    assert found == route if error is None else isinstance(found, Refusal) and found.error == error


def test_hops_go_down_and_up() -> None:
    judge, _, route = make()
    way = Way("tcp", "2")
    for address in ("1", None):
        judge.hop_down("tcp", address, "cut")
        assert judge.is_down(TCP)
        assert judge.why_down(TCP) == "cut"
        refusal = judge.find_route(ASKED, way)
        assert refusal == Refusal(AdsError.HOST_UNREACHABLE, "far (1 by tcp) is down: cut", route)
        judge.hop_up("tcp", address)
        assert judge.find_route(ASKED, way) == route
    judge.hop_down("tcp", "3", "cut")
    assert not judge.is_down(TCP)
    assert judge.why_down(TCP) == ""
    assert judge.why_down(Way("gone", "1")) == "this station has no door gone"


def test_circle_has_addresses_and_command_of_what_waits() -> None:
    judge, waiting, route = make()
    assert judge.find_circle(ASKED, b"addresses", route) is None
    waiting.add(Pending(9, ASKED, TCP, route, b"addresses", 0, 1))
    found = judge.find_circle(ASKED, b"addresses", route)
    assert found is not None
    assert (found.error, found.outcome) == (AdsError.TARGET_MACHINE, Outcome.LOOP)
    assert judge.find_circle(ASKED, b"others", route) is None
    write = AmsHeader(FAR, 1, CLIENT, 2, 3, invoke_id=9)
    assert judge.find_circle(write, b"addresses", route) is None
    waiting.pop(9)
    waiting.add(Pending(9, ASKED, TCP, None, b"addresses", 0, 1))
    assert judge.find_circle(ASKED, b"addresses", route) is None


def test_only_doors_that_may_double_packets_look_for_doubles() -> None:
    judge, waiting, route = make()
    for number, way in enumerate((TCP, SEGMENT)):
        waiting.add(Pending(number, ASKED, way, route, b"addresses", 0, 1))
    assert judge.is_again(ASKED, b"addresses", SEGMENT)
    assert not judge.is_again(ASKED, b"addresses", TCP)


def test_room_is_limited_by_connection_and_in_all() -> None:
    judge, waiting, route = make()
    assert judge.find_room(TCP) is None
    waiting.add(Pending(1, ASKED, TCP, route, b"", 0, 1))
    refusal = judge.find_room(TCP)
    assert refusal is not None
    assert refusal.error is AdsError.MAILBOX_FULL
    assert judge.find_room(SEGMENT) is None
    waiting.add(Pending(2, ASKED, SEGMENT, route, b"", 0, 1))
    other = Way("tcp", "3")
    assert judge.find_room(other) is not None
    waiting.abandon(TCP)
    assert judge.find_room(other) is None
    assert len(waiting) == 1
