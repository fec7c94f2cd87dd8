"""Pending requests, their invoke IDs, and packets that run in a circle."""

from __future__ import annotations

from eap.ams.inflight import MAX_PASSED, InFlight, InvokeIds, LoopDetector, Pending, is_marked
from eap.ams.routes import Route
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, NetId


def test_ids_are_marked_and_differ() -> None:
    ids = InvokeIds(123_456_789)
    given = [ids.allocate(()) for _ in range(10_000)]
    assert len(set(given)) == len(given)
    assert all(map(is_marked, given))
    assert all(0 < each < 1 << 32 for each in given)


def test_counted_client_ids_are_not_marked() -> None:
    assert not any(map(is_marked, range(100_000)))
    high = [each for each in range(1 << 31, (1 << 31) + 100_000) if is_marked(each)]
    assert len(high) < 1000


def test_taken_ids_are_left_out_and_numbers_come_round() -> None:
    first = InvokeIds(5).allocate(())
    assert InvokeIds(5).allocate({first}) == InvokeIds(6).allocate(())
    last = InvokeIds((1 << 22) - 2)
    assert last.allocate(()) & (1 << 22) - 1 == (1 << 22) - 1
    assert last.allocate(()) & (1 << 22) - 1 == 0
    assert is_marked(last.allocate(()))


def test_only_the_latest_packets_are_known() -> None:
    loop_detector = LoopDetector()
    for number in range(MAX_PASSED + 1):
        loop_detector.add(number, b"addresses")
    assert (0, b"addresses") not in loop_detector
    assert (1, b"addresses") in loop_detector
    assert (1, b"others") not in loop_detector


ONE, TWO, LINK = Endpoint("tcp", "1"), Endpoint("tcp", "2"), Endpoint("link", "6")
ROUTE = Route(NetId(b"target"), "far", LINK)


def pending(
    invoke_id: int, endpoint: Endpoint | None = ONE, at_ns: int = 0, allowed_ns: int = 10,
    route: Route | None = ROUTE,
) -> Pending:  # fmt: skip
    header = AmsHeader(NetId(b"target"), 1, NetId(b"source"), 2, 2, invoke_id=7)
    return Pending(
        invoke_id, header, endpoint, route, b"addresses", at_ns, at_ns + allowed_ns, may_repeat=True
    )


def filled(*items: Pending) -> InFlight:
    waiting = InFlight()
    for each in items:
        waiting.add(each)
    return waiting


def test_request_is_found_until_it_is_taken_out() -> None:
    first = pending(1)
    waiting = filled(first, pending(2, TWO))
    assert waiting.get(1) is first
    assert 1 in waiting
    assert (len(waiting), waiting.count(ONE)) == (2, 1)
    assert [waiting.count_of_transport(transport) for transport in ("tcp", "link")] == [2, 0]
    assert waiting.has_request(ONE, b"addresses", 7)
    assert waiting.pop(1) is first
    assert waiting.pop(1) is None
    assert (len(waiting), waiting.count(ONE)) == (1, 0)
    assert waiting.count_of_transport("tcp") == 1
    assert not waiting.has_request(ONE, b"addresses", 7)
    assert waiting.has_request(TWO, b"addresses", 7)


def test_repeated_request_is_known_until_latest_is_removed() -> None:
    waiting = filled(pending(1), pending(2))
    waiting.pop(1)
    assert waiting.has_request(ONE, b"addresses", 7)
    waiting.pop(2)
    assert not waiting.has_request(ONE, b"addresses", 7)


def test_deadlines_come_in_order_whatever_is_allowed() -> None:
    waiting = filled(pending(1, at_ns=0, allowed_ns=10), pending(2, at_ns=1, allowed_ns=3),
                     pending(3, at_ns=2, allowed_ns=10))  # fmt: skip
    assert waiting.next_timeout() == 4
    assert [each.invoke_id for each in waiting.due(10)] == [2, 1]
    for each in waiting.due(10):
        waiting.pop(each.invoke_id)
    assert waiting.next_timeout() == 12
    waiting.pop(3)
    assert waiting.next_timeout() is None


def test_abandoned_requests_are_dropped_first() -> None:
    waiting = filled(pending(1), pending(2), pending(3, TWO))
    assert not waiting.drop_abandoned()
    assert [each.invoke_id for each in waiting.abandon(ONE)] == [1, 2]
    assert waiting.abandon(ONE) == []
    assert len(waiting) == 3
    assert waiting.get(1).endpoint is None
    assert waiting.drop_abandoned()
    assert [each.invoke_id for each in waiting] == [2, 3]
    waiting.pop(2)
    assert not waiting.drop_abandoned()


def test_own_request_without_client_can_be_dropped() -> None:
    waiting = filled(pending(1, None))
    assert waiting.drop_abandoned()
    assert len(waiting) == 0


def test_requests_of_a_hop_are_found() -> None:
    other = Route(NetId(b"target"), "other", Endpoint("link", "7"))
    waiting = filled(pending(1), pending(2, route=other), pending(3, route=None))
    assert [each.invoke_id for each in waiting.on("link", "6")] == [1]
    assert [each.invoke_id for each in waiting.on("link", None)] == [1, 2]
    assert waiting.on("tcp", None) == []
