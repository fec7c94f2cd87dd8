"""Subscriber monitoring: presence of the receivers of unicast frames (ETG.1005, FrameState bit 2).

A target is asked for once an interval, sooner while the answer is in doubt, and all targets
together at most so often a second.  Whoever drives this asks, and hands over what comes of it.

Presence of a target, by :class:`PresenceTracker`:
Rule 1: a round, from one question to the next, counts for one miss or one hit at most, however much
is heard in it.  Presence changes after several rounds that agree, or at once for what is certain.
Rule 2: nothing is present that was not seen.  Where nothing can be told, or nothing was for long,
the presence is unknown.
"""

from __future__ import annotations

import heapq
from collections import deque
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from eap.ids import MacAddr

_SECOND_NS = 1_000_000_000


class SubscriberPresence(IntEnum):
    """Presence of the subscriber of a frame; the word of a frame in the process image."""

    UNKNOWN = 0
    PRESENT = 1
    MISSING = 2


class ProbeResult(Enum):
    """Evidence from one question, or from traffic without one."""

    SEEN = auto()
    """It answered, or another process that monitors it says that it is there."""
    MISSED = auto()
    """It did not answer this time."""
    ABSENT = auto()
    """Its host refuses what is sent, or another process has already asked often enough, in vain."""
    PENDING = auto()
    """Nothing new; another process is still asking."""
    BLIND = auto()
    """It cannot be told by this way."""


class PresencePolicy(NamedTuple):
    """Number of rounds after which evidence counts."""

    misses: int = 3
    """Rounds without an answer until it is missing, or rounds blind until it is unknown."""
    hits: int = 2
    """Rounds with an answer until what was missing is present; from unknown the first will do."""
    trust_ns: int = 15 * _SECOND_NS
    """How long what was told last holds when nothing new is, and at least *misses* intervals.

    More than the 8 s that a kernel with its usual settings takes to check a neighbour.
    """


DEFAULT_POLICY = PresencePolicy()


class PresenceTracker:
    """The presence of one subscriber, asked for every *interval_ns*."""

    def __init__(
        self, interval_ns: int, now_ns: int, policy: PresencePolicy = DEFAULT_POLICY
    ) -> None:
        self.presence = SubscriberPresence.UNKNOWN
        self._policy = policy
        self._patience_ns = max(policy.trust_ns, policy.misses * interval_ns)
        self._told_at_ns = now_ns
        self._hits = self._misses = self._blind = 0
        self._verdict: ProbeResult | None = None  # of this round

    def begin_round(self) -> None:
        """Note that a new question is under way."""
        self._verdict = None

    @property
    def in_doubt(self) -> bool:
        """True if the next round may change something: it had better come soon."""
        return bool(self._hits if self.presence is SubscriberPresence.MISSING else self._misses)

    def take(self, evidence: ProbeResult, now_ns: int) -> SubscriberPresence:
        """Count *evidence* and return the presence that follows."""
        before = self.presence
        match evidence:
            case ProbeResult.SEEN:
                self._hit(now_ns)
            case ProbeResult.MISSED | ProbeResult.ABSENT:
                self._miss(evidence, now_ns)
            case ProbeResult.BLIND:
                self._look_in_vain()
            case ProbeResult.PENDING:
                if now_ns - self._told_at_ns > self._patience_ns:
                    self.presence = SubscriberPresence.UNKNOWN
        if self.presence is not before:
            self._hits = self._misses = self._blind = 0
        return self.presence

    def _hit(self, now_ns: int) -> None:
        self._told_at_ns = now_ns
        self._misses = self._blind = 0
        if self._verdict is not ProbeResult.SEEN:
            self._verdict = ProbeResult.SEEN
            self._hits += 1
        if self.presence is not SubscriberPresence.MISSING or self._hits >= self._policy.hits:
            self.presence = SubscriberPresence.PRESENT

    def _miss(self, evidence: ProbeResult, now_ns: int) -> None:
        if evidence is ProbeResult.MISSED and self._verdict is ProbeResult.SEEN:
            return
        self._told_at_ns = now_ns
        self._hits = self._blind = 0
        if self._verdict is not ProbeResult.MISSED:
            self._verdict = ProbeResult.MISSED
            self._misses += 1
        if evidence is ProbeResult.ABSENT or self._misses >= self._policy.misses:
            self.presence = SubscriberPresence.MISSING

    def _look_in_vain(self) -> None:
        if self._verdict is None:
            self._verdict = ProbeResult.BLIND
            self._blind += 1
        if self._blind >= self._policy.misses:
            self.presence = SubscriberPresence.UNKNOWN


_CLAIMANTS_KEPT = 64
_NOT_PLANNED = -1


class MonitorTarget(NamedTuple):
    """Host whose presence is monitored."""

    name: str
    """Unique within the monitor."""
    interval_ns: int
    mac: MacAddr | None = None
    """Where the frames go: an answer from another MAC address does not count.  None: any does."""


class MonitorPolicy(NamedTuple):
    """Rates and times of questions."""

    answer_ns: int = 500_000_000
    """How long an answer may take; never longer than the interval."""
    retry_ns: int = _SECOND_NS
    """Interval while in doubt, if it is the shorter one."""
    claim_ns: int = 10 * _SECOND_NS
    """How long not to ask a host that is checking whether its address is free.

    It would take the question for a rival's (RFC 5227 2.1.1) and give the address up; its own check
    takes 9 s at most.
    """
    claimant_ns: int = 60 * _SECOND_NS
    """Who goes on asking for longer than *claim_ns*, with no gap longer than this, monitors too."""
    probes_per_s: int = 50
    """Most questions in any second, to all targets together."""
    presence: PresencePolicy = DEFAULT_POLICY


USUAL_POLICY = MonitorPolicy()


class PresenceChanged(NamedTuple):
    """A target came, went or was lost from sight."""

    name: str
    old: SubscriberPresence
    new: SubscriberPresence
    cause: ProbeResult
    answered_by: MacAddr | None
    """Who answered last for its address; not where the frames go if it is missing all the same."""


class _AddressClaim:
    """Questions of one host for an address that it may want for itself."""

    __slots__ = ("first_ns", "last_ns")

    def __init__(self, now_ns: int) -> None:
        self.first_ns = self.last_ns = now_ns


class _Watch:
    """One target, and the round that it is in."""

    def __init__(self, target: MonitorTarget, now_ns: int, policy: PresencePolicy) -> None:
        self.target = target
        self.tracker = PresenceTracker(target.interval_ns, now_ns, policy)
        self.answered_by: MacAddr | None = None
        self.waits = False
        self.queued = False
        self.asked_at_ns = now_ns - target.interval_ns
        self.due_ns = self.claimed_until_ns = now_ns
        self.claims: dict[MacAddr, _AddressClaim] = {}

    def ask(self, now_ns: int) -> None:
        self.tracker.begin_round()
        self.asked_at_ns = now_ns
        self.waits = True
        self.queued = False

    def claim(self, mac: MacAddr, now_ns: int, policy: MonitorPolicy) -> bool:
        """Note a claim of *mac*; return whether to keep quiet for it."""
        known = self.claims.get(mac)
        if known is None or now_ns - known.last_ns > policy.claimant_ns:
            if len(self.claims) >= _CLAIMANTS_KEPT:
                del self.claims[next(iter(self.claims))]
            known = self.claims[mac] = _AddressClaim(now_ns)
        known.last_ns = now_ns
        until_ns = known.first_ns + policy.claim_ns
        self.claimed_until_ns = max(self.claimed_until_ns, until_ns)
        return until_ns > now_ns


class SubscriberMonitor:
    """Decides which target is asked when, and evaluates the answers.

    The driver's turn: hand over all that was heard, then :meth:`probes_to_send`, ask for each of
    those, and come again at :meth:`next_timeout`.  What cannot be asked gets Evidence.BLIND; who
    looks instead of asking hands over what it saw at once.
    """

    def __init__(self, now_ns: int, policy: MonitorPolicy = USUAL_POLICY) -> None:
        self._policy = policy
        self._watches: dict[str, _Watch] = {}
        self._heap: list[tuple[int, str]] = []
        self._queue: deque[_Watch] = deque()
        self._events: deque[PresenceChanged] = deque()
        burst = max(1, policy.probes_per_s // 10)
        self._gap_ns = -(-_SECOND_NS // (policy.probes_per_s - burst + 1))
        self._slack_ns = (burst - 1) * self._gap_ns
        self._booked_ns = now_ns

    def add(self, target: MonitorTarget, now_ns: int) -> None:
        """Watch *target* from now on; one of the same name is forgotten with all it was."""
        self._watches[target.name] = watch = _Watch(target, now_ns, self._policy.presence)
        heapq.heappush(self._heap, (watch.due_ns, target.name))

    def remove(self, name: str) -> None:
        """Forget target *name*; one that is not there is no error."""
        self._watches.pop(name, None)

    def presence(self, name: str) -> SubscriberPresence:
        """Return what is known of target *name*; unknown for one that is not watched."""
        watch = self._watches.get(name)
        return SubscriberPresence.UNKNOWN if watch is None else watch.tracker.presence

    def next_timeout(self) -> int | None:
        """Return when :meth:`probes_to_send` must be called again; None if never."""
        times = [self._heap[0][0]] if self._heap else []
        if self._queue:
            times.append(self._booked_ns - self._slack_ns)
        return min(times, default=None)

    def probes_to_send(self, now_ns: int) -> list[str]:
        """Return the names of the targets to ask for now, first who has waited longest."""
        self.handle_timeout(now_ns)
        names = []
        while self._queue and now_ns >= self._booked_ns - self._slack_ns:
            watch = self._queue.popleft()
            if self._watches.get(watch.target.name) is not watch:
                continue
            if watch.claimed_until_ns > now_ns:
                self._postpone(watch)
                continue
            self._booked_ns = max(self._booked_ns, now_ns) + self._gap_ns
            watch.ask(now_ns)
            self._schedule(watch)
            names.append(watch.target.name)
        return names

    def handle_timeout(self, now_ns: int) -> None:
        """Judge the questions whose answer is late, and queue the targets that are due."""
        while self._heap and self._heap[0][0] <= now_ns:
            due_ns, name = heapq.heappop(self._heap)
            watch = self._watches.get(name)
            if watch is None or watch.due_ns != due_ns or watch.queued:
                continue
            watch.due_ns = _NOT_PLANNED
            if watch.waits:
                self._take(watch, ProbeResult.MISSED, now_ns)
            elif watch.claimed_until_ns > now_ns:
                self._postpone(watch)
            else:
                watch.queued = True
                self._queue.append(watch)

    def receive_reply(self, name: str, mac: MacAddr, now_ns: int) -> None:
        """Take note that *mac* has the address of target *name*; unknown names are ignored."""
        watch = self._watches.get(name)
        if watch is None:
            return
        watch.answered_by = mac
        if watch.target.mac in {None, mac}:
            self._take(watch, ProbeResult.SEEN, now_ns)

    def receive_claim(self, name: str, mac: MacAddr, now_ns: int) -> None:
        """Take note that *mac* asks whether it may take the address of target *name*.

        Other monitors ask the same way, but never stop: those are not waited for.
        """
        watch = self._watches.get(name)
        if watch is not None and watch.claim(mac, now_ns, self._policy):
            self._take(watch, ProbeResult.PENDING, now_ns)

    def receive_evidence(self, name: str, evidence: ProbeResult, now_ns: int) -> None:
        """Take *evidence* about target *name*; unknown names are ignored."""
        watch = self._watches.get(name)
        if watch is not None:
            self._take(watch, evidence, now_ns)

    def next_event(self) -> PresenceChanged | None:
        """Return the next change of a presence, None when there is none."""
        return self._events.popleft() if self._events else None

    def _take(self, watch: _Watch, evidence: ProbeResult, now_ns: int) -> None:
        watch.waits = False
        old = watch.tracker.presence
        new = watch.tracker.take(evidence, now_ns)
        if new is not old:
            name = watch.target.name
            self._events.append(PresenceChanged(name, old, new, evidence, watch.answered_by))
        if not watch.queued:
            self._schedule(watch)

    def _postpone(self, watch: _Watch) -> None:
        watch.queued = False
        watch.due_ns = watch.claimed_until_ns
        heapq.heappush(self._heap, (watch.due_ns, watch.target.name))

    def _schedule(self, watch: _Watch) -> None:
        """Note when something is to be done about *watch*: its answer is late, or it is due."""
        pause_ns = watch.target.interval_ns
        if watch.waits:
            pause_ns = min(pause_ns, self._policy.answer_ns)
        elif watch.tracker.in_doubt:
            pause_ns = min(pause_ns, self._policy.retry_ns)
        due_ns = watch.asked_at_ns + pause_ns
        if due_ns != watch.due_ns:
            watch.due_ns = due_ns
            heapq.heappush(self._heap, (due_ns, watch.target.name))
