from __future__ import annotations

from eap.ams.admission import RouterLimits
from eap.ams.record import Outcome
from tests.support.ams import DELETE_NOTIFICATION, Ams, parse
from tests.support.aoerouter import CLIENT, FAR, FAR_DEVICE, LINK, SECOND_LINK, Station, route
from tests.unit.eap.ams.test_notification_forwarder import (
    ADD,
    NOTICE,
    ONE,
    TWO,
    granted,
    subscribed,
)
from tests.unit.eap.ams.test_subscriptions import stream

SECOND = 1_000_000_000


def test_notification_that_nobody_asked_for_is_ended_where_it_comes_from() -> None:
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


def test_notification_that_comes_before_its_answer_is_not_ended() -> None:
    station = Station([route(FAR, LINK)])
    onward = station.forwarded(ADD, ONE)
    notice = NOTICE._replace(body=stream((5, {1: b"data"})))
    assert station.give(notice, LINK) == []
    station.replied(onward.answer(granted(1)), LINK)
    assert station.replied(notice, LINK) == (ONE, notice)


def test_nothing_is_ended_when_there_is_no_room_to_wait_for_it() -> None:
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
