from __future__ import annotations

import struct

import pytest

from eap.aoe.routes import Route
from eap.aoe.subscriptions import MAX_PER_WAY, Subscription, Subscriptions, divide
from eap.aoe.way import Way
from eap.errors import TruncatedError
from eap.ids import NetId

ONE, TWO, LINK = Way("tcp", "1"), Way("tcp", "2"), Way("link", "6")
ROUTE = Route(NetId(b"target"), "far", LINK)
ONWARD, SERVER = b"server__client__", b"virtual_"


def grant(handle: int, route: Route = ROUTE, server: bytes = SERVER) -> Subscription:
    return Subscription(ONWARD, handle, route, server)


def stream(*stamps: tuple[int, dict[int, bytes]]) -> bytes:
    content = b""
    for time, samples in stamps:
        content += struct.pack("<QI", time, len(samples))
        for handle, data in samples.items():
            content += struct.pack("<II", handle, len(data)) + data
    return struct.pack("<II", len(content) + 4, len(stamps)) + content


def test_subscription_belongs_to_the_connection_that_has_it_now() -> None:
    all_ = Subscriptions()
    assert all_.add(ONE, grant(1)) is None
    all_.add(TWO, grant(1))
    assert all_.find(ONWARD, 1) == (TWO, grant(1))
    assert all_.close(ONE) == []
    assert all_.close(TWO) == [grant(1)]
    assert len(all_) == 0
    assert all_.remove(ONWARD, 1) is None


def test_oldest_of_a_connection_makes_room() -> None:
    all_ = Subscriptions()
    for handle in range(MAX_PER_WAY):
        assert all_.add(ONE, grant(handle)) is None
    assert all_.add(ONE, grant(MAX_PER_WAY)) == grant(0)
    assert all_.add(TWO, grant(0)) is None
    assert len(all_) == MAX_PER_WAY + 1


def test_those_of_a_hop_are_forgotten() -> None:
    all_ = Subscriptions()
    other = Route(NetId(b"target"), "other", Way("link", "7"))
    all_.add(ONE, grant(1))
    all_.add(ONE, grant(2, other))
    all_.forget_hop("link", "6")
    assert all_.find(ONWARD, 1) is None
    all_.forget_hop("link", None)
    assert len(all_) == 0


def test_notification_for_one_connection_stays_as_it_is() -> None:
    all_ = Subscriptions()
    for handle in (1, 2):
        all_.add(ONE, grant(handle))
    body = stream((5, {1: b"a"}), (5, {2: b"bb"}))
    assert divide(body, ONWARD, all_, lambda _: True) == {(ONE, SERVER): body}
    assert divide(body, ONWARD, all_, lambda hop: hop != LINK) == {}
    assert divide(body, b"other", all_, lambda _: True) == {}


def test_notification_for_several_is_divided_and_unknown_handles_are_left_out() -> None:
    all_ = Subscriptions()
    all_.add(ONE, grant(1))
    all_.add(ONE, grant(3))
    all_.add(TWO, grant(2))
    body = stream((5, {1: b"a", 2: b"bb", 3: b"ccc"}), (6, {2: b"", 9: b"x"}))
    assert divide(body, ONWARD, all_, lambda _: True) == {
        (ONE, SERVER): stream((5, {1: b"a", 3: b"ccc"})),
        (TWO, SERVER): stream((5, {2: b"bb"}), (6, {2: b""})),
    }


def test_every_prefix_is_truncated() -> None:
    body = stream((5, {1: b"a", 2: b"bb"}), (6, {2: b"end"}))
    for end in range(len(body)):
        with pytest.raises(TruncatedError):
            divide(body[:end], ONWARD, Subscriptions(), lambda _: True)
