"""Packing, matching, losses and the budget of a cycle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from devicebus.errors import FrameLostError
from devicebus.master.cyclicframe import (
    MAX_BODY,
    MAX_DATAGRAMS,
    CyclicExchange,
    prepare_frames,
)
from devicebus.master.link import (
    BACKOFF_LIMIT_NS,
    CEILING_NS,
    FLOOR_NS,
    INDEXES,
    LINGER_NS,
    MAX_DATA,
    MAX_PIGGYBACK,
    Link,
    RoundTrip,
)
from devicebus.wire.datagram import Command, DatagramReply, brd, fprd, fpwr, logical
from tests.support.busline import MS, accesses_of, answer


def test_round_trip_not_measured_has_the_back_off_limit():
    trip = RoundTrip()
    assert (trip.timeout_ns, trip.smoothed_ns) == (BACKOFF_LIMIT_NS, 0)
    assert RoundTrip(ceiling_ns=3 * MS).timeout_ns == 3 * MS


def test_round_trip_follows_rfc_6298():
    trip = RoundTrip()
    trip.measure(8 * MS)
    assert (trip.smoothed_ns, trip.timeout_ns) == (8 * MS, 24 * MS)
    trip.measure(16 * MS)
    assert (trip.smoothed_ns, trip.timeout_ns) == (9 * MS, 9 * MS + 4 * 5 * MS)


@pytest.mark.parametrize(
    ("trip_ns", "timeout_ns"), [(20_000, FLOOR_NS), (5_000 * MS, CEILING_NS), (0, FLOOR_NS)]
)
def test_round_trip_has_a_floor_and_a_ceiling(trip_ns, timeout_ns):
    trip = RoundTrip()
    for _ in range(50):
        trip.measure(trip_ns)
    assert trip.timeout_ns == timeout_ns


def test_round_trip_backs_off_up_to_the_limit():
    trip = RoundTrip()
    trip.measure(MS // 2)
    waits = [trip.timeout_of(number, 9) // MS for number in range(1, 10)]
    assert waits == [2, 4, 8, 16, 32, 64, 100, 100, 100]
    assert [trip.timeout_of(number, 3) // MS for number in (1, 2, 3)] == [2, 4, 100]
    assert trip.timeout_of(1, 1) == FLOOR_NS


def test_round_trip_longer_than_the_limit_is_the_time_out():
    trip = RoundTrip()
    trip.measure(100 * MS)
    assert [trip.timeout_of(number, 3) // MS for number in (1, 2, 3)] == [300] * 3


READ = fprd(1001, 0x130, 6)


class CycleSpy(CyclicExchange):
    """One cycle; *outcomes* are the last frame that came back, and when."""

    def __init__(self, *requests):
        self.outcomes: list = []
        super().__init__(prepare_frames(requests), 1, 0, (), self._note)

    def _note(self, exchange, now_ns):
        self.outcomes.append((exchange.replies[-1], now_ns))


def submit_cycle(link, *requests):
    exchange = CycleSpy(*requests)
    link.submit_cycle(exchange)
    return exchange


class Client:
    """Somebody who asks."""

    def __init__(self, link: Link):
        self.link = link
        self.outcomes: list = []

    def ask(self, *accesses, **options):
        return self.link.submit(accesses, lambda out, now: self.outcomes.append((out, now)),
                                **options)  # fmt: skip


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def quick():
    """A link of which a round trip is known, so that frames are overdue after 2 ms."""
    link = Link()
    Client(link).ask(READ)
    for frame in link.frames_to_send(0):
        link.receive_frame(answer(frame), 50_000)
    return link


def test_link_shares_frames_between_exchanges(link):
    one, two = Client(link), Client(link)
    one.ask(READ, fpwr(1001, 0x120, b"\2\0"))
    two.ask(READ)
    assert not link.is_waiting
    (frame,) = link.frames_to_send(0)
    assert link.is_waiting
    assert accesses_of(frame) == [READ, fpwr(1001, 0x120, b"\2\0"), READ]
    assert link.frames_to_send(1) == []
    link.receive_frame(answer(frame, data=b"abcdef"), 50)
    assert one.outcomes == [([DatagramReply(b"abcdef", 1), DatagramReply(b"ab", 1)], 50)]
    assert two.outcomes == [([DatagramReply(b"abcdef", 1)], 50)]
    assert (link.stats().sent, link.stats().received) == (1, 1)
    assert not link.is_waiting


def test_link_exchange_of_several_frames_is_done_with_the_last(link):
    client = Client(link)
    client.ask(*[fprd(1001, 0x1000, 1000)] * 3)
    frames = link.frames_to_send(0)
    assert len(frames) == 3
    for frame in reversed(frames[1:]):
        link.receive_frame(answer(frame), 1)
        assert client.outcomes == []
    link.receive_frame(answer(frames[0]), 2)
    assert [reply.wkc for reply in client.outcomes[0][0]] == [1, 1, 1]


def test_frames_hold_no_more_than_a_frame_holds(link):
    client = Client(link)
    client.ask(*[fprd(1001, 0, 1)] * 40)
    client.ask(fprd(1001, 0x1000, MAX_DATA))
    frames = link.frames_to_send(0)
    assert [len(accesses_of(frame)) for frame in frames] == [MAX_DATAGRAMS] * 2 + [10, 1]
    assert max(len(frame) for frame in frames) == MAX_BODY + 2


@pytest.mark.parametrize("accesses", [(), (fprd(1001, 0x1000, MAX_DATA + 1),)])
def test_link_refuses_a_datagram_longer_than_a_frame(link, accesses):
    with pytest.raises(ValueError, match=str(MAX_DATA)):
        Client(link).ask(*accesses)


def test_link_repeats_with_growing_pauses_and_fails(quick):
    client = Client(quick)
    client.ask(READ)
    now = 0
    for wait_ms in (2, 4, 8, 16, 100):
        assert len(quick.frames_to_send(now)) == 1
        assert quick.next_timeout() == now + wait_ms * MS
        quick.handle_timeout(now + wait_ms * MS - 1)
        assert quick.frames_to_send(now) == []
        now += wait_ms * MS
        quick.handle_timeout(now)
    ((error, failed_at),) = client.outcomes
    assert isinstance(error, FrameLostError)
    assert "FPRD 0x03E9:0x0130" in str(error)
    assert "sent 5 times" in str(error)
    assert (failed_at, quick.next_timeout(), quick.frames_to_send(now)) == (now, None, [])
    stats = quick.stats()
    assert (stats.sent, stats.retried, stats.lost) == (6, 4, 0)
    quick.handle_timeout(now + LINGER_NS)
    assert quick.stats().lost == 5
    assert not quick.is_waiting


def test_link_repeats_as_often_as_configured():
    link = Link(retries=1, ceiling_ns=5 * MS)
    client = Client(link)
    client.ask(READ)
    client.ask(replace(READ, tries=1))
    for number in range(2):
        assert len(link.frames_to_send(5 * MS * number)) == 1
        link.handle_timeout(5 * MS * (number + 1))
    assert [type(outcome) for outcome, _ in client.outcomes] == [FrameLostError] * 2
    assert [at for _, at in client.outcomes] == [5 * MS, 10 * MS]


def test_link_reply_has_the_number_of_tries(quick):
    client = Client(quick)
    client.ask(READ)
    quick.frames_to_send(0)
    quick.handle_timeout(2 * MS)
    (frame,) = quick.frames_to_send(2 * MS)
    quick.receive_frame(answer(frame, data=b"abcdef"), 2 * MS)
    assert client.outcomes == [([DatagramReply(b"abcdef", 1, 2)], 2 * MS)]


def test_link_accepts_a_late_frame_and_drops_the_second(quick):
    client = Client(quick)
    client.ask(READ)
    (late,) = quick.frames_to_send(0)
    quick.handle_timeout(2 * MS)
    (again,) = quick.frames_to_send(2 * MS)
    quick.receive_frame(answer(late, data=b"abcdef"), 3 * MS)
    assert client.outcomes == [([DatagramReply(b"abcdef", 1, 2)], 3 * MS)]
    quick.receive_frame(answer(again, data=b"second"), 3 * MS)
    quick.receive_frame(answer(again, data=b"third!"), 3 * MS)
    assert len(client.outcomes) == 1
    stats = quick.stats()
    assert (stats.late, stats.lost, stats.retried, stats.unexpected) == (1, 0, 1, 1)
    assert not quick.is_waiting


def test_link_does_not_repeat_a_datagram_answered_by_a_late_frame(quick):
    client = Client(quick)
    client.ask(READ)
    (late,) = quick.frames_to_send(0)
    quick.handle_timeout(2 * MS)
    quick.receive_frame(answer(late), 2 * MS)
    assert quick.frames_to_send(3 * MS) == []
    assert len(client.outcomes) == 1


def test_link_keeps_the_index_of_a_frame_that_may_still_come(quick):
    client = Client(quick)
    client.ask(replace(READ, tries=1))
    (late,) = quick.frames_to_send(0)
    quick.handle_timeout(2 * MS)
    for _ in range(300):
        client.ask(READ)
        (frame,) = quick.frames_to_send(3 * MS)
        assert frame[3] != late[3]
        quick.receive_frame(answer(frame), 3 * MS)
    assert len(client.outcomes) == 301
    quick.receive_frame(answer(late), 4 * MS)
    assert (quick.stats().late, quick.stats().unexpected) == (1, 0)


def test_link_counts_the_oldest_as_lost_when_all_indexes_are_taken():
    link = Link(ceiling_ns=2 * MS)
    client = Client(link)
    for number in range(INDEXES + 8):
        client.ask(replace(READ, tries=1))
        link.frames_to_send(number)
        link.handle_timeout(3 * MS)
    assert (len(client.outcomes), link.stats().lost) == (INDEXES + 8, 8)


def test_link_learns_the_round_trip_from_late_frames(quick):
    client = Client(quick)
    for number in range(40):
        client.ask(READ)
        now = number * 1000 * MS
        frames = quick.frames_to_send(now)
        quick.handle_timeout(now + 30 * MS)
        frames += quick.frames_to_send(now + 30 * MS)
        for frame in frames:
            quick.receive_frame(answer(frame), now + 30 * MS)
    assert len(client.outcomes) == 40
    stats = quick.stats()
    assert stats.timeout_ns > 30 * MS
    assert 0 < stats.late < 20


@pytest.mark.parametrize(
    "other",
    [
        fprd(1002, 0x130, 6),
        fprd(1001, 0x131, 6),
        fprd(1001, 0x130, 7),
        fpwr(1001, 0x130, bytes(6)),
    ],
)
def test_link_frame_with_other_datagrams_is_malformed(link, other):
    client = Client(link)
    client.ask(READ)
    link.frames_to_send(0)
    elsewhere = Link()
    Client(elsewhere).ask(other)
    link.receive_frame(answer(elsewhere.frames_to_send(0)[0]), 1)
    assert (client.outcomes, link.stats().malformed) == ([], 1)


def test_link_matches_incremented_positions(link):
    client = Client(link)
    client.ask(replace(READ, command=Command.APRD, adp=0xFFFF))
    frame = bytearray(link.frames_to_send(0)[0])
    frame[4:6] = b"\2\0"
    link.receive_frame(bytes(frame), 1)
    assert len(client.outcomes) == 1


@given(st.binary(max_size=40))
def test_link_survives_any_frame(octets):
    link = Link()
    client = Client(link)
    client.ask(READ)
    (frame,) = link.frames_to_send(0)
    link.receive_frame(octets, 1)
    link.receive_frame(frame[: len(frame) - 1], 1)
    assert client.outcomes == []
    link.receive_frame(answer(frame) + octets, 1)
    assert len(client.outcomes) == 1


def test_link_cancelled_exchange_is_neither_sent_nor_answered(link):
    client = Client(link)
    waiting = client.ask(READ)
    waiting.cancel()
    assert link.frames_to_send(0) == []
    under_way = client.ask(READ)
    (frame,) = link.frames_to_send(0)
    under_way.cancel()
    link.receive_frame(answer(frame), 1)
    lost = client.ask(replace(READ, tries=1))
    link.frames_to_send(1)
    lost.cancel()
    link.handle_timeout(9 * MS)
    assert (client.outcomes, link.frames_to_send(9 * MS)) == ([], [])


def test_link_limits_acyclic_frames_in_flight(link):
    client = Client(link)
    for _ in range(20):
        client.ask(fprd(1001, 0x1000, MAX_DATA))
    frames = link.frames_to_send(0)
    assert len(frames) == 8
    link.receive_frame(answer(frames[3]), 1)
    assert len(link.frames_to_send(1)) == 1


def test_indexes_go_round_and_pass_by_those_that_are_awaited(link):
    client = Client(link)
    client.ask(READ)
    link.frames_to_send(0)
    seen = []
    for _ in range(256):
        client.ask(READ)
        (frame,) = link.frames_to_send(0)
        seen.append(frame[3])
        link.receive_frame(answer(frame), 1)
    assert (seen[254], seen[255], 0 in seen) == (255, 1, False)


def test_link_sends_cyclic_frames_first_with_short_acyclic_datagrams():
    link = Link(acyclic_octets=3000)
    client = Client(link)
    long = fprd(1001, 0x1000, MAX_PIGGYBACK)
    client.ask(READ, READ, long, READ)
    link.start_cycle()
    cyclic = logical(Command.LRW, 0x10000, bytes(20))
    exchange = submit_cycle(link, cyclic)
    first, second = link.frames_to_send(0)
    assert accesses_of(first) == [replace(cyclic, tries=0), READ, READ]
    assert accesses_of(second) == [long, READ]
    link.receive_frame(answer(first, wkc=7), 1)
    assert exchange.outcomes == [(answer(first, wkc=7), 1)]
    assert len(client.outcomes) == 0
    link.receive_frame(answer(second), 2)
    assert [len(replies) for replies, _ in client.outcomes] == [4]


def test_link_adds_no_acyclic_datagram_without_budget_or_space():
    link = Link(acyclic_octets=64)
    client = Client(link)
    client.ask(READ, READ)
    link.start_cycle()
    submit_cycle(link, logical(Command.LRW, 0x10000, bytes(MAX_DATA)))
    first, second = link.frames_to_send(0)
    assert (len(accesses_of(first)), accesses_of(second)) == (1, [READ])
    submit_cycle(link, logical(Command.LRW, 0x10000, bytes(20)))
    (third,) = link.frames_to_send(1)
    assert len(accesses_of(third)) == 1


def test_link_repeats_acyclic_datagrams_of_an_overdue_cyclic_frame():
    link = Link(acyclic_octets=3000)
    client = Client(link)
    client.ask(READ)
    link.start_cycle()
    exchange = submit_cycle(link, logical(Command.LRW, 0x10000, bytes(20)))
    link.frames_to_send(0)
    assert not exchange.is_overdue
    link.handle_timeout(BACKOFF_LIMIT_NS)
    assert exchange.is_overdue
    (again,) = link.frames_to_send(BACKOFF_LIMIT_NS)
    assert accesses_of(again) == [READ]
    link.handle_timeout(BACKOFF_LIMIT_NS + LINGER_NS)
    assert exchange.is_lost
    assert exchange.outcomes == [(b"", BACKOFF_LIMIT_NS + LINGER_NS)]
    assert client.outcomes == []


def test_link_cycle_sends_its_budget_and_one_datagram_at_most():
    link = Link(acyclic_octets=400)
    client = Client(link)
    for _ in range(10):
        client.ask(fprd(1001, 0x1000, 500))
    sent = []
    for cycle in range(20):
        link.start_cycle()
        frames = link.frames_to_send(cycle)
        sent.append(sum(len(each.data) for frame in frames for each in accesses_of(frame)))
        for frame in frames:
            link.receive_frame(answer(frame), cycle)
    assert len(client.outcomes) == 10
    assert sent[:6] == [500, 500, 500, 500, 0, 500]
    assert link.stats().max_acyclic_octets == 512
    link.stop_cycles()
    for _ in range(3):
        client.ask(fprd(1001, 0x1000, 500))
    assert len(link.frames_to_send(99)) == 2


def test_short_datagrams_cost_more_of_the_budget_than_their_octets():
    link = Link(acyclic_octets=256)
    for _ in range(10):
        Client(link).ask(fprd(1001, 0x80D, 1))
    link.start_cycle()
    (frame,) = link.frames_to_send(0)
    assert len(accesses_of(frame)) == 4


@pytest.mark.parametrize(
    ("access", "is_blamed"), [(fprd(1001, 0x130, 2), False), (brd(0, 1), True)]
)
def test_link_lost_frame_blames_the_first_cable_only_after_a_broadcast(access, is_blamed):
    link = Link(retries=0)
    outcomes = []
    link.submit([access], lambda outcome, now_ns: outcomes.append(outcome))
    now_ns = 0
    while not outcomes:
        link.frames_to_send(now_ns)
        now_ns = link.next_timeout()
        link.handle_timeout(now_ns)
    (error,) = outcomes
    assert isinstance(error, FrameLostError)
    assert ("check the cable to the first slave" in str(error)) is is_blamed
