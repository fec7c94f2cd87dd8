from __future__ import annotations

import struct
from itertools import count

import pytest

from eap.ams import subscriptions as module
from eap.ams.routes import Route
from eap.ams.subscriptions import (
    MAX_PER_CLIENT,
    Division,
    Grant,
    Subscription,
    Subscriptions,
    divide,
)
from eap.codec.adsnotification import AddNotification, TransMode
from eap.errors import TruncatedError
from eap.ids import Endpoint, NetId
from tests.support.ams import parse

ONE, TWO, LINK = Endpoint("tcp", "1"), Endpoint("tcp", "2"), Endpoint("link", "6")
ROUTE = Route(NetId(b"target"), "far", LINK)
ASKED, ONWARD = b"virtual_client__", b"server__client__"
CYCLIC = AddNotification(0x4040, 0, 4, TransMode.SERVER_CYCLE, 0, 500_000)
ON_CHANGE = AddNotification(0x4040, 0, 4, TransMode.SERVER_ON_CHANGE, 0, 500_000)
SECOND = 1_000_000_000


def grant(handle: int, route: Route = ROUTE) -> Grant:
    return Grant(ONWARD, handle, route)


def one(
    handle: int,
    endpoint: Endpoint = ONE,
    route: Route = ROUTE,
    request: AddNotification | None = CYCLIC,
) -> Subscription:
    return Subscription(endpoint, ASKED, grant(handle, route), 0, request)


def added(all_: Subscriptions, *these: Subscription) -> list[Subscription]:
    for each in these:
        assert all_.add(each) is None
    return [*these]


def stream(*stamps: tuple[int, dict[int, bytes]]) -> bytes:
    content = b""
    for time, samples in stamps:
        content += struct.pack("<QI", time, len(samples))
        for handle, data in samples.items():
            content += struct.pack("<II", handle, len(data)) + data
    return struct.pack("<II", len(content) + 4, len(stamps)) + content


def divided(
    body: bytes, all_: Subscriptions, onward: bytes = ONWARD, hop: Endpoint = LINK
) -> Division:
    return divide(body, onward, all_, 7, lambda each: each == hop)


def test_subscriptions_finds_by_grant_and_by_client_handle() -> None:
    all_ = Subscriptions()
    first, second = added(all_, one(1), one(2, TWO))
    assert all_.find(ONWARD, 1) is first
    assert all_.find_of_client(TWO, ASKED, 2) is second
    assert all_.find_of_client(ONE, ASKED, 2) is None
    assert set(all_) == {first, second}
    assert all_.hops == {LINK: 2}
    assert all_.remove(first) == grant(1)
    assert all_.close(TWO) == [grant(2)]
    assert (len(all_), all_.hops, all_.endpoints(), first.is_closed) == (0, {}, [], True)


def test_subscriptions_displaces_earlier_owner_of_grant() -> None:
    all_ = Subscriptions()
    kept, of_another_router = added(all_, one(1), one(2, TWO, request=None))
    third, fourth = one(1), one(2, TWO, request=None)
    assert all_.add(third) is kept
    assert (kept.is_closed, kept.grant, kept.handle) == (False, None, 1)
    assert third.handle >= 0xC0000000  # its client knows handle 1 as another one
    assert all_.add(fourth) is of_another_router
    assert of_another_router.is_closed
    assert fourth.handle == 2
    assert len(all_) == 3


def test_subscriptions_suspended_keeps_what_is_to_be_deleted_unless_it_was_given_again() -> None:
    all_ = Subscriptions()
    first, second = added(all_, one(1), one(2))
    for each in (first, second):
        all_.suspend(each)
    assert all_.find(ONWARD, 1) is None
    assert all_.attach(second, grant(1)) is None
    assert all_.detach(first) is None  # 1 is that of the second now
    assert all_.find(ONWARD, 1) is second
    assert second.handle == 2


def test_subscriptions_of_few_hosts_leave_space_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MAX_TOTAL", 100)
    all_ = Subscriptions()
    hosts = ("10.0.0.5", "10.0.0.6", "10.0.0.7")
    handles = count()
    for endpoint in [Endpoint("ams-tcp", f"{host}:{port}") for host in hosts for port in range(32)]:
        while all_.is_within_limits(endpoint, ASKED, 1):
            added(all_, one(next(handles), endpoint))
    assert all_.is_within_limits(Endpoint("ams-tcp", "10.0.0.8:1"), ASKED, 6)


def test_subscriptions_limits_one_client() -> None:
    all_ = Subscriptions()
    added(all_, *(one(handle) for handle in range(MAX_PER_CLIENT - 1)))
    assert all_.is_within_limits(ONE, ASKED, 1)
    assert not all_.is_within_limits(ONE, ASKED, 2)
    assert all_.is_within_limits(TWO, ASKED, 2)


def test_subscriptions_of_a_hop_are_found() -> None:
    all_ = Subscriptions()
    other = Route(NetId(b"target"), "other", Endpoint("link", "7"))
    first, second = added(all_, one(1), one(2, route=other))
    assert all_.of_hop("link", "6") == [first]
    assert all_.of_hop("link", None) == [first, second]
    assert all_.of_hop("tcp", None) == []


@pytest.mark.parametrize(
    ("request_", "checks", "limit_s"),
    [
        (CYCLIC, 0, 2),
        (CYCLIC, 2, 8),
        (CYCLIC, 99, 120),
        (AddNotification(0, 0, 4, TransMode.SERVER_CYCLE, 10_000_000, 90_000_000), 0, 30),
        (ON_CHANGE, 0, 30),
        (ON_CHANGE, 9, 120),
    ],
)
def test_subscription_is_checked_the_later_the_longer_it_was_found_alive(
    request_: AddNotification, checks: int, limit_s: int
) -> None:
    subscription = one(1, request=request_)
    subscription.checks = checks
    assert subscription.quiet_limit_ns() == limit_s * SECOND


def test_subscription_end_is_a_sample_without_bytes() -> None:
    subscription = one(9)
    end = parse(subscription.encode_end(SECOND))
    assert end.body == stream((0, {9: b""}))
    subscription.time, subscription.received_at_ns = 1000, SECOND
    assert parse(subscription.encode_end(2 * SECOND)).body == stream((10_001_000, {9: b""}))


def test_notification_for_one_connection_stays_as_it_is() -> None:
    all_ = Subscriptions()
    first, second = added(all_, one(1), one(2))
    body = stream((5, {1: b"a"}), (6, {2: b"bb"}))
    assert divided(body, all_) == ([(ONE, ASKED, body)], [], [], LINK)
    assert (first.received_at_ns, first.time, second.time) == (7, 5, 6)
    assert divided(body, all_, hop=ONE) == ([], [], [1, 2], None)
    assert divided(body, all_, b"other") == ([], [], [1, 2], None)


def test_notification_for_several_is_divided_and_unknown_handles_are_left_out() -> None:
    all_ = Subscriptions()
    _, second, third, _ = added(all_, one(1), one(2, TWO), one(3), one(4))
    all_.attach(third, grant(30))
    body = stream((5, {1: b"a", 2: b"bb", 30: b"ccc"}), (6, {2: b"", 9: b"x"}))
    assert divided(body, all_) == (
        [(ONE, ASKED, stream((5, {1: b"a", 3: b"ccc"}))), (TWO, ASKED, stream((5, {2: b"bb"})))],
        [second],
        [9],
        LINK,
    )


def test_notification_of_an_unchanged_value_is_left_out_after_a_check_only() -> None:
    all_ = Subscriptions()
    (subscription,) = added(all_, one(1, request=ON_CHANGE))
    body = stream((5, {1: b"a"}))
    assert divided(body, all_).parts
    subscription.skips_repeat, subscription.checks = True, 3
    assert not divided(body, all_).parts
    assert subscription.checks == 3
    assert divided(body, all_).parts
    subscription.skips_repeat = True
    assert divided(stream((5, {1: b"b"})), all_).parts
    assert subscription.checks == 0


def test_notification_prefix_is_truncated() -> None:
    body = stream((5, {1: b"a", 2: b"bb"}), (6, {2: b"end"}))
    for end in range(len(body)):
        with pytest.raises(TruncatedError):
            divided(body[:end], Subscriptions())
