from __future__ import annotations

import struct

from eap.aoe.routes import Route
from eap.aoe.way import Way
from eap.ids import NetId
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
    route,
)
from tests.unit.eap.aoe.test_subscriptions import stream

SECOND = 1_000_000_000
ONE, TWO = Way("tcp", "1"), Way("tcp", "2")
LOCAL, ALSO_LOCAL = Way("local", "1"), Way("local", "2")
ADD = Ams(FAR_DEVICE, CLIENT, ADD_NOTIFICATION, body=bytes(40))
NOTICE = Ams(CLIENT, FAR_DEVICE, NOTIFICATION)


def granted(handle: int, result: int = 0) -> bytes:
    return result.to_bytes(4, "little") + handle.to_bytes(4, "little")


def subscribed(*ways: Way, routes: tuple[Route, ...] = (route(FAR, LINK),)) -> Station:
    """Return a station by which each way has one notification; the handles count from 1."""
    station = Station(routes)
    asked = ADD._replace(target=f"{routes[0].net_id}:851")
    for handle, way in enumerate(ways, 1):
        onward = station.forwarded(asked, way)
        assert station.replied(onward.answer(granted(handle)), LINK)[0] == way
    return station


def test_notification_goes_to_who_asked_for_it_with_one_address_for_both() -> None:
    station = subscribed(ONE, TWO)
    for handle, way in ((1, ONE), (2, TWO)):
        notice = NOTICE._replace(body=stream((5, {handle: b"data"})))
        assert station.replied(notice, LINK) == (way, notice)
    both = NOTICE._replace(body=stream((5, {1: b"a", 2: b"b"})))
    parts = {each.way: parse(*each.packets).body for each in station.give(both, LINK)}
    assert parts == {ONE: stream((5, {1: b"a"})), TWO: stream((5, {2: b"b"}))}


def test_notifications_reach_clients_with_the_net_id_of_the_router() -> None:
    station = Station([route(FAR, LINK)])
    own = f"{ROUTER}:30000"
    for handle, way in ((1, LOCAL), (2, ALSO_LOCAL)):
        onward = station.forwarded(ADD._replace(source=own), way)
        assert station.replied(onward.answer(granted(handle)), LINK)[0] == way
        notice = NOTICE._replace(target=own, body=stream((5, {handle: b"data"})))
        assert station.replied(notice, LINK) == (way, notice)


def test_notification_for_the_router_that_no_client_has_is_ended() -> None:
    station = Station([route(FAR, LINK)])
    notice = NOTICE._replace(target=f"{ROUTER}:30000", body=stream((5, {9: b"data"})))
    way, end = station.replied(notice, LINK)
    assert (way, end.command, end.body) == (LINK, DELETE_NOTIFICATION, b"\x09\0\0\0")


def test_notification_comes_from_the_address_that_was_asked() -> None:
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


def test_deleted_notification_is_forgotten_by_its_client_only() -> None:
    station = subscribed(ONE)
    delete = ADD._replace(command=DELETE_NOTIFICATION, body=b"\1\0\0\0")
    station.forwarded(delete, TWO)
    station.forwarded(delete._replace(body=b"\2\0\0\0"), ONE)
    station.forwarded(delete._replace(body=b""), ONE)
    assert station.router.stats().subscriptions == 1
    station.forwarded(delete, ONE)
    assert station.router.stats().subscriptions == 0


def test_sum_commands_are_followed() -> None:
    station = Station([route(FAR, LINK)])
    sum_add = struct.pack("<IIII", 0xF085, 3, 24, 120) + bytes(120)
    add = ADD._replace(command=READ_WRITE, body=sum_add)
    answer = granted(1) + granted(0, 0x702) + granted(3)
    body = struct.pack("<II", 0, len(answer)) + answer + b"tail"
    station.replied(station.forwarded(add, ONE).answer(body), LINK)
    notice = NOTICE._replace(body=stream((5, {1: b"a", 3: b"b"})))
    assert station.replied(notice, LINK) == (ONE, notice)
    for handles in (b"\1\0\0\0\x09\0\0\0", b"\3\0\0\0\3\0"):
        delete = struct.pack("<IIII", 0xF086, 2, 8, 8) + handles
        station.forwarded(add._replace(body=delete), ONE)
    assert station.router.stats().subscriptions == 0
    station.forwarded(add._replace(body=b"short"), ONE)
    station.forwarded(add._replace(body=struct.pack("<IIII", 0xF080, 3, 24, 0)), ONE)
