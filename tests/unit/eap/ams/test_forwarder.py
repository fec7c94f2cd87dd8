"""Requests that go on and answers that come back; then any order of all that can happen."""

from __future__ import annotations

import pytest

from eap.ams.inflight import RouterLimits, is_marked
from eap.ams.record import Outcome
from eap.ams.routes import Route
from eap.ams.transport_table import Forward
from eap.codec.ams import AmsAnswer, StateFlags
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams, parse
from tests.support.aoerouter import (
    CLIENT,
    DEVICE,
    FAR,
    FAR_DEVICE,
    LINK,
    SECOND_LINK,
    Station,
    only_reply,
    route,
)

SECOND = 1_000_000_000
ONE, TWO = (Endpoint("tcp", f"10.0.0.9:{port}") for port in (4711, 4712))
ASKED = Ams(FAR_DEVICE, CLIENT, invoke_id=1, body=b"which")


def test_forwarder_replaces_invoke_id_and_restores_it() -> None:
    station = Station([route(FAR, LINK)])
    onward = station.forwarded(ASKED, ONE)
    assert onward == ASKED._replace(invoke_id=onward.invoke_id)
    assert is_marked(onward.invoke_id)
    assert station.replied(onward.answer(b"that"), LINK) == (ONE, ASKED.answer(b"that"))
    assert station.router.stats().in_flight == 0


def test_equal_requests_of_one_address_on_two_connections_are_kept_apart() -> None:
    station = Station([route(FAR, LINK)])
    first, second = (station.forwarded(ASKED, endpoint) for endpoint in (ONE, TWO))
    assert first.invoke_id != second.invoke_id
    assert station.replied(second.answer(b"2"), LINK) == (TWO, ASKED.answer(b"2"))
    assert station.replied(first.answer(b"1"), LINK) == (ONE, ASKED.answer(b"1"))


def test_error_from_behind_the_hop_is_passed_back_and_named() -> None:
    station = Station([route(FAR, LINK, "island")])
    onward = station.forwarded(ASKED, ONE)
    assert station.replied(onward.answer(b"", 6), LINK) == (ONE, ASKED.answer(b"", 6))
    ((outcome, text),) = station.events()
    assert outcome is Outcome.ANSWERED
    assert text.startswith(f"READ of {FAR_DEVICE} for {CLIENT} ({ONE}): ")
    assert text.endswith(
        f": error 0x6 (nothing has that AMS port) from island ({LINK}) or from behind it"
    )


@pytest.mark.parametrize(
    ("change", "endpoint"),
    [
        ({"invoke_id": 5}, LINK),
        ({"command": 3}, LINK),
        ({"target": "192.168.0.8.1.1:30000"}, LINK),
        ({}, SECOND_LINK),
        ({}, ONE),
    ],
)
def test_forwarder_drops_unexpected_answers(change: dict, endpoint: Endpoint) -> None:
    station = Station([route(FAR, LINK)])
    answer = station.forwarded(ASKED, ONE).answer()
    assert station.give(answer._replace(**change), endpoint) == []
    (event,) = station.events()
    assert event[0] is Outcome.LATE
    assert "no request waits for" in event[1]
    assert station.replied(answer, LINK)[0] == ONE
    assert station.give(answer, LINK) == []


def test_answer_for_a_service_by_a_packet_is_nobodys() -> None:
    station = Station()
    ticket = station.delivered(ASKED._replace(target=DEVICE), ONE).ticket
    forged = ASKED._replace(target=DEVICE, invoke_id=ticket).answer()
    assert station.give(forged, TWO) == []
    assert station.router.receive_answer(ticket, AmsAnswer(), 0)


def test_forwarder_accepts_answers_by_shared_connection() -> None:
    station = Station([route(FAR, Endpoint("broker", FAR))])
    onward = station.forwarded(ASKED, ONE)
    assert station.replied(onward.answer(), Endpoint("broker", "it")) == (ONE, ASKED.answer())


def test_time_out_is_answered_before_the_client_gives_up_and_names_the_hop() -> None:
    station = Station([route(FAR, LINK, "island"), route("7.1.1.1.1.1", LINK, timeout_ns=SECOND)])
    onward = station.forwarded(ASKED, ONE)
    hasty = ASKED._replace(target="7.1.1.1.1.1:1")
    station.forwarded(hasty, TWO)
    assert station.router.next_timeout() == SECOND
    assert station.router.handle_timeout(SECOND - 1) == []
    assert only_reply(station.router.handle_timeout(SECOND)) == (TWO, hasty.answer(b"", 0x719))
    due = station.router.next_timeout()
    assert due is not None
    assert due < 5 * SECOND
    assert only_reply(station.router.handle_timeout(due)) == (ONE, ASKED.answer(b"", 0x719))
    assert f"no answer from island ({LINK}) within 4.5 s" in station.events()[-1][1]
    assert station.give(onward.answer(), LINK) == []
    assert station.router.next_timeout() is None


def test_request_by_a_hop_that_is_dead_names_the_hop_and_not_the_target() -> None:
    near = NetId.parse("5.1.1.2.1.1")
    beyond = route(FAR, LINK, "far", router=near)
    station = Station([beyond, Route(near, "near", LINK)])
    station.forwarded(ASKED, ONE)
    station.router.handle_timeout(5 * SECOND)
    text = f"no answer from near ({LINK}) or from behind it within 4.5 s"
    assert station.events()[-1][1].endswith(text)
    station.forwarded(ASKED, ONE)
    station.router.hop_down(*LINK, "it does not answer", 0)
    assert station.events()[-1][1].endswith(f"near ({LINK}): it does not answer")
    station.replied(ASKED, ONE)
    assert station.events()[-1][1].endswith(f"near ({LINK}) is down: it does not answer")


def test_service_that_says_nothing_is_answered_for() -> None:
    station = Station()
    asked = ASKED._replace(target=DEVICE)
    ticket = station.delivered(asked, ONE).ticket
    actions = station.router.handle_timeout(5 * SECOND)
    assert only_reply(actions) == (ONE, asked.answer(b"", 0x719))
    assert station.router.receive_answer(ticket, AmsAnswer(), 6 * SECOND) == []
    assert "no answer from its service" in station.events()[0][1]


def test_hop_that_is_down_is_answered_at_once() -> None:
    station = Station([route(FAR, LINK, "island"), route("7.1.1.1.1.1", SECOND_LINK)])
    onward = station.forwarded(ASKED, ONE)
    unreachable = ONE, ASKED.answer(b"", 0x1B)
    assert only_reply(station.router.hop_down(*LINK, "no answer to probes", 1)) == unreachable
    assert "island (10.0.0.6 by link): no answer to probes" in station.events()[0][1]
    assert station.replied(ASKED, ONE) == unreachable
    assert "is down" in station.events()[0][1]
    assert station.give(onward.answer(), LINK) == []
    assert station.forwarded(ASKED._replace(target="7.1.1.1.1.1:1"), ONE)
    station.router.hop_up(*LINK)
    assert station.forwarded(ASKED, ONE)


def test_forwarder_transport_down_fails_all_its_hops() -> None:
    station = Station([route(FAR, LINK), route("7.1.1.1.1.1", SECOND_LINK)])
    station.forwarded(ASKED, ONE)
    station.forwarded(ASKED._replace(target="7.1.1.1.1.1:1"), ONE)
    assert len(station.router.hop_down("link", None, "broker gone", 1)) == 2
    assert station.replied(ASKED, ONE)[1].error == 0x1B
    station.router.hop_up("link", None)
    assert station.forwarded(ASKED, ONE)


def test_forwarder_replies_to_request_that_was_not_sent() -> None:
    station = Station([route(FAR, LINK)])
    (action,) = station.give(ASKED, ONE)
    assert isinstance(action, Forward)
    failed = station.router.send_failed(action.ticket, "connection refused", 1)
    assert only_reply(failed) == (ONE, ASKED.answer(b"", 0x1B))
    assert "connection refused" in station.events()[0][1]
    assert station.router.send_failed(action.ticket, "again", 1) == []


def test_forwarder_closed_connection_gets_no_answer() -> None:
    station = Station([route(FAR, LINK)])
    gone, stays = (station.forwarded(ASKED, endpoint) for endpoint in (ONE, TWO))
    ticket = station.delivered(ASKED._replace(target=DEVICE), ONE).ticket
    assert station.router.connection_closed(*ONE, 1) == []
    assert station.router.receive_answer(ticket, AmsAnswer(), 1) == []
    assert station.give(gone.answer(), LINK) == []
    assert station.events()[0][0] is Outcome.LATE
    assert station.replied(stays.answer(), LINK)[0] == TWO
    assert station.router.stats().in_flight == 0


def test_forwarder_closed_connection_is_forgotten_after_timeout_or_hop_loss() -> None:
    station = Station([route(FAR, LINK)])
    for _ in range(2):
        station.forwarded(ASKED, ONE)
        station.router.connection_closed(*ONE, 1)
        assert station.router.stats().in_flight == 1
        assert station.router.handle_timeout(5 * SECOND) == []
        station.forwarded(ASKED, ONE)
        station.router.connection_closed(*ONE, 1)
        assert station.router.hop_down(*LINK, "gone", 1) == []
        assert station.router.stats().in_flight == 0
        station.router.hop_up(*LINK)


def test_virtual_net_id_is_translated_there_and_back() -> None:
    station = Station([route("10.0.0.6.1.1", LINK, real=NetId.parse(FAR))])
    asked = ASKED._replace(target="10.0.0.6.2.1:1001")
    onward = station.forwarded(asked, ONE)
    assert onward.target == "6.1.1.1.2.1:1001"
    assert station.replied(onward.answer(), LINK) == (ONE, asked.answer())
    station.table.add(route("7.1.1.1.1.1", SECOND_LINK))
    back = Ams("7.1.1.1.1.1:1", FAR_DEVICE)
    assert station.forwarded(back, LINK).source == "10.0.0.6.1.1:851"


def test_forwarder_refuses_requests_from_unidirectional_route() -> None:
    station = Station([route(FAR, LINK, "island", is_unidirectional=True),
                       route("7.1.1.1.1.1", SECOND_LINK)])  # fmt: skip
    assert station.forwarded(ASKED, ONE)
    back = Ams("7.1.1.1.1.1:1", FAR_DEVICE)
    assert station.replied(back, LINK) == (LINK, back.answer(b"", 0x723))
    assert "route island is unidirectional" in station.events()[0][1]


def test_forwarder_refuses_route_back_to_source() -> None:
    segment = Endpoint("segment", "02:00:00:00:00:06")
    station = Station([route(FAR, segment), route("7.1.1.1.1.1", LINK)])
    for asked, endpoint in ((ASKED, Endpoint("segment", "02:00:00:00:00:07")),
                       (ASKED._replace(target="7.1.1.1.1.1:1"), LINK)):  # fmt: skip
        assert station.replied(asked, endpoint) == (endpoint, asked.answer(b"", 7))
        (event,) = station.events()
        assert event[0] is Outcome.LOOP
        assert "leads back to where it came from" in event[1]
    assert station.forwarded(ASKED._replace(target="7.1.1.1.1.1:1"), SECOND_LINK)


def test_circle_of_stations_is_found_in_one_round() -> None:
    first = Station([route(FAR, LINK)], first_id=1)
    second = Station([route(FAR, SECOND_LINK)], first_id=1)
    once = first.forwarded(ASKED, ONE)
    twice = second.forwarded(once, Endpoint("tcp", "first"))
    assert twice == once
    back = Endpoint("tcp", "second")
    assert first.replied(twice, back) == (back, twice.answer(b"", 7))
    (event,) = first.events()
    assert event[0] is Outcome.LOOP
    assert "run in a circle" in event[1]
    unwound = second.replied(twice.answer(b"", 7), SECOND_LINK)[1]
    assert first.replied(unwound, LINK) == (ONE, ASKED.answer(b"", 7))


def test_forwarder_finds_loop_after_client_is_gone() -> None:
    station = Station([route(FAR, LINK)])
    once = station.forwarded(ASKED, ONE)
    station.router.connection_closed(*ONE, 1)
    assert station.replied(once, TWO)[1].error == 7


def test_same_id_of_two_routers_is_no_circle() -> None:
    station = Station([route(FAR, LINK)])
    marked = ASKED._replace(invoke_id=Station([route(FAR, LINK)]).forwarded(ASKED, ONE).invoke_id)
    other = marked._replace(source="192.168.0.8.1.1:30000")
    kept, changed = station.forwarded(marked, ONE), station.forwarded(other, TWO)
    assert kept == marked
    assert changed.invoke_id != marked.invoke_id
    assert station.replied(changed.answer(), LINK) == (TWO, other.answer())
    assert station.replied(kept.answer(), LINK) == (ONE, marked.answer())


def test_packet_without_answer_is_passed_once() -> None:
    quiet = ASKED._replace(flags=StateFlags.ADS | StateFlags.NO_RETURN)
    station = Station([route(FAR, LINK)])
    once, other = station.forwarded(quiet, ONE), station.forwarded(quiet, ONE)
    assert once.invoke_id != other.invoke_id
    assert station.give(once, TWO) == []
    assert station.events()[0][0] is Outcome.LOOP
    assert Station([route(FAR, LINK)], first_id=5).forwarded(once, ONE) == once
    assert station.router.stats().in_flight == 0


def test_forwarder_drops_repeated_request_on_datagram_transport() -> None:
    station = Station([route(FAR, LINK)])
    there = Endpoint("segment", "02:00:00:00:00:09")
    onward = station.forwarded(ASKED, there)
    assert station.give(ASKED, there) == []
    assert station.events()[0][0] is Outcome.DROPPED
    assert station.forwarded(ASKED._replace(invoke_id=2), there)
    assert station.replied(onward.answer(), LINK) == (there, ASKED.answer())
    assert station.forwarded(ASKED, there)
    local = ASKED._replace(target=DEVICE)
    station.delivered(local, there)
    assert station.give(local, there) == []


def test_requests_that_wait_are_limited() -> None:
    limits = RouterLimits(in_flight=3, per_connection=2)
    station = Station([route(FAR, LINK)], limits=limits)
    for _ in range(2):
        station.forwarded(ASKED, ONE)
    assert station.replied(ASKED, ONE) == (ONE, ASKED.answer(b"", 4))
    assert "2 requests of the connection wait already" in station.events()[0][1]
    station.forwarded(ASKED, TWO)
    assert station.replied(ASKED, TWO) == (TWO, ASKED.answer(b"", 4))
    assert "3 requests wait already" in station.events()[0][1]
    local = ASKED._replace(target=DEVICE)
    assert station.replied(local, TWO) == (TWO, local.answer(b"", 4))
    station.router.connection_closed(*ONE, 1)
    for _ in range(1):
        assert station.forwarded(ASKED, TWO)
    assert station.router.stats().in_flight == 3


def test_forwarder_flood_by_one_transport_leaves_space_for_others() -> None:
    station = Station([route(FAR, LINK)], limits=RouterLimits(per_transport=2))
    for number in range(2):
        station.forwarded(ASKED, Endpoint("segment", str(number)))
    there = Endpoint("segment", "2")
    assert station.replied(ASKED, there) == (there, ASKED.answer(b"", 4))
    assert "2 requests by segment wait already, 0 of this" in station.events()[0][1]
    assert station.forwarded(ASKED, ONE)


def test_forwarder_flood_by_connections_leaves_space_for_another() -> None:
    station = Station([route(FAR, LINK)], limits=RouterLimits(per_transport=16))
    for port in range(4):
        endpoint = Endpoint("tcp", f"10.0.0.5:{port}")
        while isinstance(station.give(ASKED, endpoint)[0], Forward):
            pass
    assert station.forwarded(ASKED, ONE)


def test_forwarder_replies_to_route_by_missing_transport() -> None:
    station = Station([route(FAR, Endpoint("nowhere", "1"), "island")])
    assert station.replied(ASKED, ONE) == (ONE, ASKED.answer(b"", 0x1B))
    assert "route island is by nowhere" in station.events()[0][1]


def test_forwarder_sends_long_request_in_fragments() -> None:
    station = Station([route(FAR, Endpoint("narrow", "1"))])
    (action,) = station.give(ASKED._replace(body=bytes(100)), ONE)
    assert isinstance(action, Forward)
    assert len(action.packets) == 5
    assert {parse(each).command for each in action.packets} == {0x0902}
