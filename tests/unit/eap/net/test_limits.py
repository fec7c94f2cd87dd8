"""The connection policy: single rules, and all of them under random use."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from eap.net.limits import (
    FRESH_NS,
    OVERDUE_NS,
    OWN_HOST,
    SILENT_NS,
    Activity,
    CloseReason,
    Connection,
    ConnectionTable,
    Listener,
    ListenerLimits,
    Rate,
    RateLimiter,
    SourceRateLimiter,
    SourceRates,
    host_of,
)
from tests.support.examples import examples

S = 1_000_000_000
A, B, C, D = "10.0.0.1", "10.0.0.2", "10.0.0.3", "10.0.0.4"


class Peer:
    """A connection as the policy sees it."""

    def __init__(self, host: str, activity: Activity = Activity.UNUSED, at_ns: int = 1) -> None:
        self.host = host
        self.activity = activity
        self.used_at_ns = at_ns
        self.late_since_ns: int | None = None
        self.why: CloseReason | None = None

    def close(self, why: CloseReason) -> None:
        self.why = why


class Scene:
    """A table with one listener of few places."""

    def __init__(self, total: int = 6, reserved: int = 2, per_host: int = 3) -> None:
        self.table = ConnectionTable()
        self.listener = self.table.add_listener("here", ListenerLimits(total, reserved, per_host))

    def admit(
        self, peer: Peer, now_ns: int = 100 * S, spare: int = 100
    ) -> tuple[bool, Connection | None]:
        outcome = self.table.admit(self.listener, peer, now_ns, spare_descriptors=spare)
        assert (peer in self.listener.connections) == (not outcome.refusal)
        return not outcome.refusal, outcome.victim

    def fill(self, *peers: Peer) -> list[Peer]:
        for peer in peers:
            assert self.admit(peer) == (True, None)
        return list(peers)


BUSY = Activity.BUSY


def test_foreign_host_has_its_share_and_others_find_room() -> None:
    scene = Scene()
    scene.fill(Peer(A, BUSY), Peer(A, BUSY), Peer(A, BUSY))
    assert scene.admit(Peer(A)) == (False, None)
    assert scene.admit(Peer(B)) == (True, None)


def test_foreign_hosts_leave_the_reserve_to_this_host() -> None:
    scene = Scene()
    scene.fill(*(Peer(host, BUSY) for host in (A, B, C, D)))
    assert scene.admit(Peer("10.0.0.5")) == (False, None)
    oldest, _ = scene.fill(Peer(OWN_HOST, BUSY), Peer(OWN_HOST, BUSY, 2))
    assert scene.admit(Peer(OWN_HOST)) == (True, oldest), "and nothing more than the reserve"
    assert scene.listener.stats == ("here", 6, 6, 1, 1, 0, 100 * S)


def test_this_host_may_take_all_places() -> None:
    scene = Scene()
    scene.fill(*(Peer(OWN_HOST, BUSY) for _ in range(6)))
    assert scene.admit(Peer(A)) == (False, None)


def test_host_over_its_share_loses_its_own_silent_connection() -> None:
    scene = Scene()
    _, silent, _ = scene.fill(
        Peer(A, BUSY), Peer(A, Activity.IDLE, 50 * S), Peer(A, Activity.IDLE, 60 * S)
    )
    assert scene.admit(Peer(A)) == (True, silent)
    assert scene.listener.stats.evicted == 1


@pytest.mark.parametrize(
    ("others", "number"),
    [
        ([Peer(A, Activity.IDLE, 1), Peer(A, Activity.UNUSED, 2 * S), Peer(B, BUSY)], 1),
        ([Peer(A, Activity.IDLE, 7 * S), Peer(A, Activity.IDLE, 3 * S), Peer(B, BUSY)], 1),
        ([Peer(A, BUSY), Peer(A, BUSY), Peer(B, Activity.IDLE, 3 * S)], 2),
        ([Peer(A, Activity.SUBSCRIBED), Peer(A, BUSY), Peer(B, BUSY)], 1),
        ([Peer(A, Activity.SUBSCRIBED), Peer(A, Activity.SUBSCRIBED, 9), Peer(B, BUSY)], 0),
    ],
    ids=["unused", "longest silent", "silent before busy", "busy before subscribed", "oldest"],
)
def test_newcomer_takes_the_place_that_is_missed_least(others: list[Peer], number: int) -> None:
    scene = Scene(total=3, reserved=0)
    scene.fill(*others)
    assert scene.admit(Peer(C)) == (True, others[number])


def test_connection_in_use_is_kept_from_hosts_that_hold_as_many() -> None:
    scene = Scene(total=2, reserved=0)
    scene.fill(Peer(A, BUSY), Peer(B, Activity.IDLE, 100 * S - SILENT_NS + 1))
    assert scene.admit(Peer(C)) == (False, None)
    assert scene.admit(Peer(C), 100 * S + 1)[0]  # that of B has been silent for 10 s now


def test_connection_that_was_just_accepted_is_spared_for_a_silent_one() -> None:
    scene = Scene(total=3, reserved=0)
    fresh = 100 * S - FRESH_NS + 1
    _, silent, _ = scene.fill(Peer(A, at_ns=fresh), Peer(A, Activity.IDLE, 80 * S), Peer(B, BUSY))
    assert scene.admit(Peer(A, at_ns=100 * S)) == (True, silent)


def test_connection_that_was_just_accepted_is_spared_while_another_host_holds_more() -> None:
    scene = Scene(total=4, reserved=0)
    fresh = Peer(C, at_ns=100 * S - FRESH_NS + 1)
    oldest, *_ = scene.fill(Peer(A, BUSY, 1), Peer(A, BUSY, 2), Peer(A, BUSY, 3), fresh)
    assert scene.admit(Peer(C, at_ns=100 * S)) == (True, oldest)


def test_burst_of_this_host_leaves_descriptors_to_other_listeners() -> None:
    scene = Scene(reserved=0)
    oldest, *_ = scene.fill(*(Peer(OWN_HOST, at_ns=100 * S - 6 + n) for n in range(6)))
    control = scene.table.add_listener("control", ListenerLimits())
    found = scene.table.admit(control, Peer("process 7"), 100 * S, spare_descriptors=0)
    assert found == ("", oldest)


def test_burst_of_silent_connections_does_not_lock_out_its_own_host() -> None:
    scene = Scene(total=6, reserved=0, per_host=6)
    oldest, *_ = scene.fill(*(Peer(OWN_HOST, at_ns=100 * S - 6 + n) for n in range(6)))
    assert scene.admit(Peer(OWN_HOST, at_ns=100 * S)) == (True, oldest)


@pytest.mark.parametrize(
    ("second", "third", "number"),
    [
        ((Activity.IDLE, 99 * S), (Activity.IDLE, 98 * S), 2),
        ((BUSY, 2 * S), (Activity.SUBSCRIBED, 1 * S), 1),
        ((Activity.SUBSCRIBED, 2 * S), (Activity.SUBSCRIBED, 1 * S), 2),
    ],
    ids=["longest silent", "busy before subscribed", "oldest subscription"],
)
def test_connections_in_use_do_not_lock_other_programs_of_this_host_out(
    second: tuple[Activity, int], third: tuple[Activity, int], number: int
) -> None:
    scene = Scene(total=3, reserved=0)
    last = Peer(OWN_HOST, Activity.SUBSCRIBED, 99 * S)
    held = scene.fill(last, Peer(OWN_HOST, *second), Peer(OWN_HOST, *third))
    assert scene.admit(Peer(A)) == (False, None), "other hosts displace nothing in use here"
    assert scene.admit(Peer(OWN_HOST)) == (True, held[number])


def test_host_with_many_connections_does_not_displace_those_of_others() -> None:
    scene = Scene(total=3, reserved=0)
    single, *_ = scene.fill(Peer(A), Peer(B, BUSY), Peer(B, BUSY))
    assert scene.admit(Peer(B)) == (False, None)
    assert single in scene.listener.connections


def test_short_descriptors_take_places_of_any_listener() -> None:
    scene = Scene()
    other = scene.table.add_listener("there", ListenerLimits())
    greedy = [Peer(A, at_ns=number) for number in range(3)]
    for each in greedy:
        scene.table.admit(other, each, S, spare_descriptors=100)
    assert scene.admit(Peer(B), spare=1) == (True, None)
    assert scene.admit(Peer(B), spare=0) == (True, greedy[0])
    assert (other.stats.evicted, scene.listener.stats.evicted) == (1, 0)


def test_short_descriptors_without_a_victim_refuse() -> None:
    scene = Scene()
    scene.fill(Peer(A, BUSY))
    assert scene.admit(Peer(B), spare=0) == (False, None)
    assert scene.table.shed(100 * S) is None
    scene.fill(idle := Peer(A))
    assert scene.table.shed(100 * S) is idle


def test_peer_that_lets_something_wait_is_overdue_after_its_time() -> None:
    scene = Scene()
    slow, quick = scene.fill(Peer(A, BUSY), Peer(A))
    slow.late_since_ns = 5 * S
    assert scene.table.remove_overdue(5 * S + OVERDUE_NS - 1) == []
    assert scene.table.remove_overdue(5 * S + OVERDUE_NS) == [slow]
    assert scene.table.remove_overdue(5 * S + OVERDUE_NS) == []
    assert list(scene.listener.connections) == [quick]
    assert scene.listener.stats.overdue == 1
    scene.table.remove(scene.listener, slow)  # as its end does


def test_host_of_this_machine_is_known_by_its_address() -> None:
    assert host_of("127.9.2.1", "127.0.0.1") == host_of("10.0.0.1", "10.0.0.1") == OWN_HOST
    assert host_of("10.0.0.2", "10.0.0.1") == "10.0.0.2"


def test_reason_names_what_is_short() -> None:
    reasons = []
    for total, reserved, per_host in ((2, 0, 3), (3, 1, 3), (3, 1, 2)):
        scene = Scene(total, reserved, per_host)
        scene.fill(Peer(A, BUSY), Peer(A, BUSY))
        reasons.append(scene.listener.find_shortage(A)[0])
    assert reasons == [
        "all 2 places are taken",
        "other hosts have 2 connections, their share",
        "10.0.0.1 has 2 connections, its share",
    ]


class Use(RuleBasedStateMachine):
    """Connections that come, work, fall silent, dawdle and go at two listeners."""

    hosts = st.sampled_from([OWN_HOST, A, B, C])

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 100 * S
        self.table = ConnectionTable()
        self.listeners = [
            self.table.add_listener("small", ListenerLimits(6, 2, 3)),
            self.table.add_listener("large", ListenerLimits(10, 3, 4)),
        ]
        self.open: dict[Peer, Listener] = {}
        self.refused = self.evicted = 0

    def is_fresh(self, peer: Peer) -> bool:
        is_young = self.now_ns - peer.used_at_ns < FRESH_NS
        return peer.activity is Activity.UNUSED and is_young

    def in_use(self, peer: Peer) -> bool:
        if self.is_fresh(peer):
            return True
        if peer.activity is Activity.IDLE:
            return self.now_ns - peer.used_at_ns < SILENT_NS
        return peer.activity is not Activity.UNUSED

    @rule(host=hosts, which=st.sampled_from([0, 1]), spare=st.sampled_from([0, 1, 50]))
    def connect(self, host: str, which: int, spare: int) -> None:
        listener, peer = self.listeners[which], Peer(host, at_ns=self.now_ns)
        before = dict(self.open)
        at_listener = [each for each, where in before.items() if where is listener]
        refusal, victim = self.table.admit(listener, peer, self.now_ns, spare_descriptors=spare)
        if refusal:
            self.refused += 1
            mine = [e for e in at_listener if e.host == host]
            assert not mine or host != OWN_HOST
            assert not any(not self.in_use(e) or self.is_fresh(e) for e in mine)
        else:
            self.open[peer] = listener
        if victim is None:
            return
        assert isinstance(victim, Peer)
        self.evicted += 1
        where = self.open.pop(victim)
        assert spare == 0 or where is listener
        held = Counter(e.host for e in before if spare == 0 or before[e] is listener)
        if self.in_use(victim):
            assert not any(not self.in_use(e) and e.host == victim.host for e in at_listener)
            if victim.host == host:
                assert self.is_fresh(victim) or host == OWN_HOST
                return
            assert victim.host != OWN_HOST or self.is_fresh(victim)
            assert held[victim.host] > held[host] + 1
        elif victim.host != host:
            assert held[victim.host] >= 1

    @precondition(lambda self: self.open)
    @rule(data=st.data(), activity=st.sampled_from(Activity))
    def work(self, data: st.DataObject, activity: Activity) -> None:
        peer = data.draw(st.sampled_from(list(self.open)))
        peer.activity, peer.used_at_ns = activity, self.now_ns

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def dawdle(self, data: st.DataObject) -> None:
        data.draw(st.sampled_from(list(self.open))).late_since_ns = self.now_ns

    @precondition(lambda self: self.open)
    @rule(data=st.data())
    def leave(self, data: st.DataObject) -> None:
        peer = data.draw(st.sampled_from(list(self.open)))
        self.table.remove(self.open.pop(peer), peer)
        self.table.remove(self.listeners[0], peer)  # again is no matter

    @rule(seconds=st.integers(1, 15))
    def pass_time(self, seconds: int) -> None:
        self.now_ns += seconds * S
        for each in self.table.remove_overdue(self.now_ns):
            assert isinstance(each, Peer)
            assert each.late_since_ns is not None
            assert self.now_ns - each.late_since_ns >= OVERDUE_NS
            del self.open[each]
        assert not any(
            each.late_since_ns is not None and self.now_ns - each.late_since_ns >= OVERDUE_NS
            for each in self.open
        )

    @invariant()
    def limits_hold_and_figures_agree(self) -> None:
        for listener in self.listeners:
            here = [peer for peer, where in self.open.items() if where is listener]
            hosts = Counter(peer.host for peer in here)
            total, reserved, per_host = listener.limits
            assert set(listener.connections) == set(here)
            assert listener.by_host == hosts
            assert len(here) <= total
            assert len(here) - hosts[OWN_HOST] <= total - reserved
            assert all(count <= per_host for host, count in hosts.items() if host != OWN_HOST)
            assert listener.stats.open == len(here)
        assert sum(each.refused for each in self.listeners) == self.refused
        assert sum(each.evicted for each in self.listeners) == self.evicted


TestUse = Use.TestCase
TestUse.settings = examples(40, stateful_step_count=60)


def takes(allowance: RateLimiter, now_s: float) -> int:
    count = 0
    while allowance.take(now_s):
        count += 1
    return count


def test_rate_limiter_allows_a_burst_and_refills() -> None:
    allowance = RateLimiter(10, 2.0, 100.0)
    assert takes(allowance, 100.0) == 10
    assert takes(allowance, 100.4) == 0
    assert takes(allowance, 102.0) == 4
    assert takes(allowance, 90.0) == 0, "a clock that goes back gives nothing"
    assert takes(allowance, 1000.0) == 10


def test_source_rate_limiter_forgets_the_source_silent_for_longest() -> None:
    one, many = Rate(1, 0.0), Rate(100, 0.0)
    limiter = SourceRateLimiter(SourceRates(one, many, many, one), 2, 0.0)
    assert [limiter.take(each, 0.0) for each in "aba"] == [True, True, False]
    assert limiter.take("c", 0.0), "in the place of b"
    assert [limiter.take(each, 0.0) for each in "ac"] == [False, False]
    assert limiter.take("b", 0.0), "which is new again"
    assert [limiter.take_local(0.0) for _ in range(2)] == [True, False]
