"""Notifications across a router, and their cleanup at servers."""

from __future__ import annotations

import struct

from eap.ams.inflight import InvokeIds, RouterLimits
from eap.ams.record import Outcome
from eap.ams.routes import Route
from eap.ams.subscriptions import MAX_PER_CLIENT
from eap.ams.transport_table import Forward
from eap.ids import Endpoint, NetId
from tests.support.ams import (
    ADD_NOTIFICATION,
    DELETE_NOTIFICATION,
    NOTIFICATION,
    READ_WRITE,
    Ams,
    parse,
)
from tests.support.aoerouter import (
    CLIENT,
    FAR,
    FAR_DEVICE,
    LINK,
    ROUTER,
    SECOND_LINK,
    Station,
    only_reply,
    route,
)
from tests.unit.eap.ams.test_subscriptions import stream

SECOND = 1_000_000_000


def test_unexpected_notification_is_ended_at_its_server() -> None:
    station = subscribed(ONE)
    end = Ams(NOTICE.source, NOTICE.target, DELETE_NOTIFICATION, flags=6, invoke_id=0)
    unknown = NOTICE._replace(body=stream((5, {9: b"", 10: b""})))
    assert station.replied(unknown, LINK) == (LINK, end._replace(body=b"\x09\0\0\0"))
    elsewhere = NOTICE._replace(body=stream((5, {1: b""})))
    ended = end._replace(body=b"\1\0\0\0")
    assert station.replied(elsewhere, SECOND_LINK) == (SECOND_LINK, ended)
    assert station.give(NOTICE._replace(body=stream()), LINK) == []
    assert station.give(NOTICE._replace(body=b"short"), LINK) == []
    assert [outcome for outcome, _ in station.events()] == [
        Outcome.LATE, Outcome.LATE, Outcome.LATE, Outcome.DROPPED
    ]  # fmt: skip


def test_notification_before_its_answer_is_not_ended() -> None:
    station = Station([route(FAR, LINK)])
    onward = station.forwarded(ADD, ONE)
    notice = NOTICE._replace(body=stream((5, {1: b"data"})))
    assert station.give(notice, LINK) == []
    station.replied(onward.answer(granted(1)), LINK)
    assert station.replied(notice, LINK) == (ONE, notice)


def test_nothing_is_ended_beyond_limit_in_flight() -> None:
    station = Station([route(FAR, LINK)], limits=RouterLimits(in_flight=1))
    station.replied(station.forwarded(ADD, ONE).answer(granted(1)), LINK)
    station.forwarded(ADD, TWO)
    assert station.router.connection_closed(*ONE, 1) == []
    assert station.router.stats().in_flight == 1


def test_closed_connection_ends_its_notifications_at_the_server() -> None:
    station = subscribed(ONE, TWO)
    (action,) = station.router.connection_closed(*ONE, 1)
    end = parse(*action.packets)
    assert (action.hop, end.command, end.body) == (LINK, DELETE_NOTIFICATION, b"\1\0\0\0")
    assert (end.target, end.source) == (FAR_DEVICE, CLIENT)
    assert station.give(end.answer(), LINK) == []
    assert station.events() == []
    assert station.router.stats().in_flight == 0
    station.router.hop_down(*LINK, "gone", 1)
    assert station.router.stats().subscriptions == 1  # it will be restored
    (end,) = station.router.connection_closed(*TWO, 1)
    assert parse(*end.packets).body == b"\2\0\0\0"
    assert station.router.stats().subscriptions == 0


def test_notification_granted_to_a_closed_connection_is_ended() -> None:
    station = Station([route(FAR, LINK)])
    onward = station.forwarded(ADD, ONE)
    station.router.connection_closed(*ONE, 1)
    (end,) = station.give(onward.answer(granted(5)), LINK)
    assert parse(*end.packets).body == b"\5\0\0\0"


def test_notification_granted_too_late_is_ended() -> None:
    station = Station([route(FAR, LINK)])
    onward = station.forwarded(ADD, ONE)
    assert len(station.router.handle_timeout(5 * SECOND)) == 1
    (action,) = station.give(onward.answer(granted(5)), LINK)
    assert parse(*action.packets).command == DELETE_NOTIFICATION
    assert station.router.handle_timeout(20 * SECOND) == []
    assert station.router.stats().in_flight == 0


ONE, TWO = Endpoint("tcp", "1"), Endpoint("tcp", "2")
LOCAL, ALSO_LOCAL = Endpoint("local", "1"), Endpoint("local", "2")
ADD = Ams(FAR_DEVICE, CLIENT, ADD_NOTIFICATION, body=bytes(40))
NOTICE = Ams(CLIENT, FAR_DEVICE, NOTIFICATION)


def granted(handle: int, result: int = 0) -> bytes:
    return result.to_bytes(4, "little") + handle.to_bytes(4, "little")


def subscribed(*endpoints: Endpoint, routes: tuple[Route, ...] = (route(FAR, LINK),)) -> Station:
    """Return a station by which each way has one notification; the handles count from 1."""
    station = Station(routes)
    asked = ADD._replace(target=f"{routes[0].net_id}:851")
    for handle, endpoint in enumerate(endpoints, 1):
        onward = station.forwarded(asked, endpoint)
        assert station.replied(onward.answer(granted(handle)), LINK)[0] == endpoint
    return station


def test_notification_reaches_its_client_among_equal_addresses() -> None:
    station = subscribed(ONE, TWO)
    for handle, endpoint in ((1, ONE), (2, TWO)):
        notice = NOTICE._replace(body=stream((5, {handle: b"data"})))
        assert station.replied(notice, LINK) == (endpoint, notice)
    both = NOTICE._replace(body=stream((5, {1: b"a", 2: b"b"})))
    parts = {each.endpoint: parse(*each.packets).body for each in station.give(both, LINK)}
    assert parts == {ONE: stream((5, {1: b"a"})), TWO: stream((5, {2: b"b"}))}


def test_notifications_reach_clients_with_the_net_id_of_the_router() -> None:
    station = Station([route(FAR, LINK)])
    own = f"{ROUTER}:30000"
    for handle, endpoint in ((1, LOCAL), (2, ALSO_LOCAL)):
        onward = station.forwarded(ADD._replace(source=own), endpoint)
        assert station.replied(onward.answer(granted(handle)), LINK)[0] == endpoint
        notice = NOTICE._replace(target=own, body=stream((5, {handle: b"data"})))
        assert station.replied(notice, LINK) == (endpoint, notice)


def test_notification_for_the_router_that_no_client_has_is_ended() -> None:
    station = Station([route(FAR, LINK)])
    notice = NOTICE._replace(target=f"{ROUTER}:30000", body=stream((5, {9: b"data"})))
    endpoint, end = station.replied(notice, LINK)
    assert (endpoint, end.command, end.body) == (LINK, DELETE_NOTIFICATION, b"\x09\0\0\0")


def test_notification_for_a_client_that_does_not_listen_is_ended() -> None:
    station = Station([route("192.168.0.9.1.1", SECOND_LINK, is_client=True)])
    notice = NOTICE._replace(body=stream((5, {9: b"data"})))
    station.forwarded(notice, LINK)  # nothing is known of it yet
    station.router.hop_down(SECOND_LINK.transport, SECOND_LINK.connection, "connection refused", 0)
    endpoint, end = station.replied(notice, LINK)
    assert (endpoint, end.command, end.body) == (LINK, DELETE_NOTIFICATION, b"\x09\0\0\0")


def test_notification_for_a_router_that_is_down_for_now_is_not_ended() -> None:
    station = Station([route("192.168.0.9.1.1", SECOND_LINK)])
    station.router.hop_down(SECOND_LINK.transport, SECOND_LINK.connection, "connection refused", 0)
    assert station.give(NOTICE._replace(body=stream((5, {9: b"data"}))), LINK) == []


def test_notification_has_address_of_the_request() -> None:
    virtual = route("10.0.0.6.1.1", LINK, real=NetId.parse(FAR))
    station = subscribed(ONE, routes=(virtual,))
    notice = NOTICE._replace(body=stream((5, {1: b"data"})))
    assert station.replied(notice, LINK) == (ONE, notice._replace(source="10.0.0.6.1.1:851"))


def test_notification_may_go_by_a_route() -> None:
    station = Station([route("192.168.0.9.1.1", SECOND_LINK)])
    notice = NOTICE._replace(body=stream((5, {1: b"data"})))
    onward = station.forwarded(notice, LINK)
    assert onward == notice._replace(invoke_id=onward.invoke_id)


def test_refused_notifications_are_not_remembered() -> None:
    for body, error in ((granted(1, 0x714), 0), (granted(1), 7), (b"\0\0\0\0", 0)):
        station = Station([route(FAR, LINK)])
        station.replied(station.forwarded(ADD, ONE).answer(body, error), LINK)
        assert station.router.stats().subscriptions == 0


def test_subscription_of_a_client_is_deleted_here_by_that_client_only() -> None:
    station = subscribed(ONE)
    delete = ADD._replace(command=DELETE_NOTIFICATION, body=b"\1\0\0\0")
    station.forwarded(delete, TWO)
    for unknown in (b"\2\0\0\0", b""):
        station.forwarded(delete._replace(body=unknown), ONE)
    assert station.router.stats().subscriptions == 1
    answer, end = station.give(delete, ONE)
    assert only_reply([answer]) == (ONE, delete.answer(bytes(4)))
    assert isinstance(end, Forward)
    assert parse(*end.packets).body == b"\1\0\0\0"
    assert station.router.stats().subscriptions == 0
    station.forwarded(delete, ONE)


def test_subscription_of_another_router_is_deleted_at_the_server() -> None:
    station = Station([route(FAR, LINK)])
    marked = ADD._replace(invoke_id=InvokeIds(7).allocate(()))
    station.replied(station.forwarded(marked, ONE).answer(granted(1)), LINK)
    delete = marked._replace(command=DELETE_NOTIFICATION, body=b"\1\0\0\0")
    assert station.forwarded(delete, ONE).body == b"\1\0\0\0"
    assert station.router.stats().subscriptions == 0


def test_sum_commands_are_followed() -> None:
    station = Station([route(FAR, LINK)])
    sum_add = struct.pack("<IIII", 0xF085, 3, 24, 120) + bytes(120)
    add = ADD._replace(command=READ_WRITE, body=sum_add)
    answer = granted(1) + granted(0, 0x702) + granted(3)
    body = struct.pack("<II", 0, len(answer)) + answer + b"tail"
    assert station.replied(station.forwarded(add, ONE).answer(body), LINK) == (
        ONE,
        add.answer(body),
    )
    notice = NOTICE._replace(body=stream((5, {1: b"a", 3: b"b"})))
    assert station.replied(notice, LINK) == (ONE, notice)
    delete = add._replace(body=struct.pack("<IIII5I", 0xF086, 4, 16, 16, 1, 9, 3, 3, 7))
    back, *ends = station.give(delete, ONE)
    results = struct.pack("<IIIIII", 0, 16, 0, 0x714, 0, 0)
    assert only_reply([back]) == (ONE, delete.answer(results))
    assert [parse(*each.packets).body[0] for each in ends] == [1, 3]
    assert station.router.stats().subscriptions == 0
    station.forwarded(add._replace(body=b"short"), ONE)
    station.forwarded(add._replace(body=struct.pack("<IIII", 0xF080, 3, 24, 0)), ONE)


def test_client_that_has_too_many_subscriptions_is_refused() -> None:
    station = Station([route(FAR, LINK)])
    count = MAX_PER_CLIENT
    add = ADD._replace(
        command=READ_WRITE, body=struct.pack("<IIII", 0xF085, count, 8 * count, 40 * count)
    )
    answer = b"".join(granted(handle) for handle in range(count))
    body = struct.pack("<II", 0, len(answer)) + answer
    station.replied(station.forwarded(add, ONE).answer(body), LINK)
    more = ADD._replace(invoke_id=2)
    assert station.replied(more, ONE) == (ONE, more.answer(granted(0, 0x716)))
    station.forwarded(more, TWO)


def test_duplicate_handle_of_client_is_replaced() -> None:
    station = subscribed(ONE)
    again = ADD._replace(invoke_id=2)
    interrupted, _ = station.give(station.forwarded(again, ONE).answer(granted(1)), LINK), None
    _, answer = only_reply(interrupted)
    assert answer.body[:4] == bytes(4)
    handle = int.from_bytes(answer.body[4:], "little")
    assert handle != 1
    notice = NOTICE._replace(body=stream((5, {1: b"data"})))
    renamed = NOTICE._replace(body=stream((5, {handle: b"data"})))
    assert station.replied(notice, LINK) == (ONE, renamed)
