"""Subscriber monitoring: presence of the receivers of unicast frames (ETG.1005, FrameState bit 2).

A target is probed once an interval, sooner while its presence is in doubt.  The rate of probes to
all targets together is limited.  The driver sends the probes and hands over their results.

Presence of a target, by :class:`PresenceTracker`:
Rule 1: a round, from one probe to the next, counts for one miss or one hit at most, even if several
results arrive in it.  Presence changes after several rounds that agree, or at once on proof.
Rule 2: a target is present only after it was seen.  Where no result can be had, or none was for
long, the presence is unknown.
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
    """Result of one probe, or of observed traffic without one."""

    SEEN = auto()
    """It replied, or another process that monitors it reports that it is there."""
    MISSED = auto()
    """It did not reply this time."""
    ABSENT = auto()
    """Its host rejects frames, or another process has probed it often enough without a reply."""
    PENDING = auto()
    """Nothing new; another process is still probing."""
    BLIND = auto()
    """This probe cannot determine the presence."""


class PresencePolicy(NamedTuple):
    """Number of rounds after which results count."""

    misses: int = 3
    """Rounds without an answer until it is missing, or rounds blind until it is unknown."""
    hits: int = 2
    """Rounds with a reply until a missing target is present; from unknown the first is enough."""
    valid_ns: int = 15 * _SECOND_NS
    """Validity of the last result without a new one, and at least *misses* intervals.

    More than the 8 s that a kernel with its usual settings takes to check a neighbour.
    """


DEFAULT_POLICY = PresencePolicy()


class PresenceTracker:
    """The presence of one subscriber, probed every *interval_ns*."""

    def __init__(
        self, interval_ns: int, now_ns: int, policy: PresencePolicy = DEFAULT_POLICY
    ) -> None:
        self.presence = SubscriberPresence.UNKNOWN
        self._policy = policy
        self._valid_ns = max(policy.valid_ns, policy.misses * interval_ns)
        self._result_at_ns = now_ns
        self._hits = self._misses = self._blind = 0
        self._round_result: ProbeResult | None = None  # of this round

    def begin_round(self) -> None:
        """Note that a new probe is under way."""
        self._round_result = None

    @property
    def in_doubt(self) -> bool:
        """True if the next round may change the presence, and so should come soon."""
        return bool(self._hits if self.presence is SubscriberPresence.MISSING else self._misses)

    def enter(self, result: ProbeResult, now_ns: int) -> SubscriberPresence:
        """Enter *result* and return the presence that follows."""
        before = self.presence
        match result:
            case ProbeResult.SEEN:
                self._hit(now_ns)
            case ProbeResult.MISSED | ProbeResult.ABSENT:
                self._miss(result, now_ns)
            case ProbeResult.BLIND:
                self._enter_unknown()
            case ProbeResult.PENDING:
                if now_ns - self._result_at_ns > self._valid_ns:
                    self.presence = SubscriberPresence.UNKNOWN
        if self.presence is not before:
            self._hits = self._misses = self._blind = 0
        return self.presence

    def _hit(self, now_ns: int) -> None:
        self._result_at_ns = now_ns
        self._misses = self._blind = 0
        if self._round_result is not ProbeResult.SEEN:
            self._round_result = ProbeResult.SEEN
            self._hits += 1
        if self.presence is not SubscriberPresence.MISSING or self._hits >= self._policy.hits:
            self.presence = SubscriberPresence.PRESENT

    def _miss(self, result: ProbeResult, now_ns: int) -> None:
        # A reply proves presence; the time-out of an older probe in the same round proves nothing.
        if result is ProbeResult.MISSED and self._round_result is ProbeResult.SEEN:
            return
        self._result_at_ns = now_ns
        self._hits = self._blind = 0
        if self._round_result is not ProbeResult.MISSED:
            self._round_result = ProbeResult.MISSED
            self._misses += 1
        if result is ProbeResult.ABSENT or self._misses >= self._policy.misses:
            self.presence = SubscriberPresence.MISSING

    def _enter_unknown(self) -> None:
        if self._round_result is None:
            self._round_result = ProbeResult.BLIND
            self._blind += 1
        if self._blind >= self._policy.misses:
            self.presence = SubscriberPresence.UNKNOWN


_MAX_CLAIMANTS = 64
_NOT_PLANNED = -1


class MonitorTarget(NamedTuple):
    """Host whose presence is monitored."""

    name: str
    """Unique within the monitor."""
    interval_ns: int
    mac: MacAddr | None = None
    """Destination of the frames: only a reply from it counts; None accepts any."""


class MonitorPolicy(NamedTuple):
    """Rates and times of probes."""

    answer_ns: int = 500_000_000
    """Time-out of a reply; never longer than the interval."""
    retry_ns: int = _SECOND_NS
    """Interval while in doubt, if it is the shorter one."""
    claim_ns: int = 10 * _SECOND_NS
    """Time without probes to a host that is checking whether its address is free.

    The host would take the probe for a rival's (RFC 5227 2.1.1) and give the address up; its own
    check takes 9 s at most.
    """
    claimant_ns: int = 60 * _SECOND_NS
    """A host that probes for longer than *claim_ns*, with no gap longer than this, is a monitor."""
    probes_per_s: int = 50
    """Maximum number of probes in any second, to all targets together."""
    presence: PresencePolicy = DEFAULT_POLICY


DEFAULT_MONITOR_POLICY = MonitorPolicy()


class PresenceChanged(NamedTuple):
    """A target came, went or was lost from sight."""

    name: str
    old: SubscriberPresence
    new: SubscriberPresence
    cause: ProbeResult
    answered_by: MacAddr | None
    """Host that replied last for the address; if the target is missing, not the destination's."""


class _AddressClaim:
    """ARP probes of one host for an address that it may claim (RFC 5227)."""

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
        # As if the last probe was an interval ago: the first one is due at once.
        self.probed_at_ns = now_ns - target.interval_ns
        self.due_ns = self.claimed_until_ns = now_ns
        self.claims: dict[MacAddr, _AddressClaim] = {}

    def begin_probe(self, now_ns: int) -> None:
        self.tracker.begin_round()
        self.probed_at_ns = now_ns
        self.waits = True
        self.queued = False

    def note_claim(self, mac: MacAddr, now_ns: int, policy: MonitorPolicy) -> bool:
        """Note a claim of *mac*; return whether to keep quiet for it."""
        known = self.claims.get(mac)
        if known is None or now_ns - known.last_ns > policy.claimant_ns:
            # Forged senders must not fill memory; the oldest claim is the first one.
            if len(self.claims) >= _MAX_CLAIMANTS:
                del self.claims[next(iter(self.claims))]
            known = self.claims[mac] = _AddressClaim(now_ns)
        known.last_ns = now_ns
        until_ns = known.first_ns + policy.claim_ns
        self.claimed_until_ns = max(self.claimed_until_ns, until_ns)
        return until_ns > now_ns


class SubscriberMonitor:
    """Schedules the probes of all targets, and evaluates the results.

    The driver hands over all results, calls :meth:`probes_to_send`, sends each of those probes, and
    calls again at :meth:`next_timeout`.  A target that cannot be probed gets ProbeResult.BLIND.  A
    driver that reads a table instead of probing hands over the result at once.
    """

    def __init__(self, now_ns: int, policy: MonitorPolicy = DEFAULT_MONITOR_POLICY) -> None:
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
        """Return the presence of target *name*; unknown for one that is not watched."""
        watch = self._watches.get(name)
        return SubscriberPresence.UNKNOWN if watch is None else watch.tracker.presence

    def next_timeout(self) -> int | None:
        """Return when :meth:`probes_to_send` must be called again; None if never."""
        times = [self._heap[0][0]] if self._heap else []
        if self._queue:
            times.append(self._booked_ns - self._slack_ns)
        return min(times, default=None)

    def probes_to_send(self, now_ns: int) -> list[str]:
        """Return the names of the targets to probe now, the one that has waited longest first."""
        self.handle_timeout(now_ns)
        names = []
        # A leaky bucket: _booked_ns is the next probe at the full rate, _slack_ns the burst.
        while self._queue and now_ns >= self._booked_ns - self._slack_ns:
            watch = self._queue.popleft()
            if self._watches.get(watch.target.name) is not watch:
                continue
            if watch.claimed_until_ns > now_ns:
                self._postpone(watch)
                continue
            self._booked_ns = max(self._booked_ns, now_ns) + self._gap_ns
            watch.begin_probe(now_ns)
            self._schedule(watch)
            names.append(watch.target.name)
        return names

    def handle_timeout(self, now_ns: int) -> None:
        """Enter a miss for each probe whose reply is late, and queue the targets that are due."""
        while self._heap and self._heap[0][0] <= now_ns:
            due_ns, name = heapq.heappop(self._heap)
            watch = self._watches.get(name)
            if watch is None or watch.due_ns != due_ns or watch.queued:
                continue
            watch.due_ns = _NOT_PLANNED
            if watch.waits:
                self._enter(watch, ProbeResult.MISSED, now_ns)
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
            self._enter(watch, ProbeResult.SEEN, now_ns)

    def receive_claim(self, name: str, mac: MacAddr, now_ns: int) -> None:
        """Note that *mac* probes whether the address of target *name* is free.

        Other monitors send the same probes, but never stop: the monitor does not wait for those.
        """
        watch = self._watches.get(name)
        if watch is not None and watch.note_claim(mac, now_ns, self._policy):
            self._enter(watch, ProbeResult.PENDING, now_ns)

    def receive_result(self, name: str, result: ProbeResult, now_ns: int) -> None:
        """Enter *result* for target *name*; unknown names are ignored."""
        watch = self._watches.get(name)
        if watch is not None:
            self._enter(watch, result, now_ns)

    def next_event(self) -> PresenceChanged | None:
        """Return the next change of a presence, None when there is none."""
        return self._events.popleft() if self._events else None

    def _enter(self, watch: _Watch, result: ProbeResult, now_ns: int) -> None:
        watch.waits = False
        old = watch.tracker.presence
        new = watch.tracker.enter(result, now_ns)
        if new is not old:
            name = watch.target.name
            self._events.append(PresenceChanged(name, old, new, result, watch.answered_by))
        if not watch.queued:
            self._schedule(watch)

    def _postpone(self, watch: _Watch) -> None:
        watch.queued = False
        watch.due_ns = watch.claimed_until_ns
        heapq.heappush(self._heap, (watch.due_ns, watch.target.name))

    def _schedule(self, watch: _Watch) -> None:
        """Set the time at which *watch* needs attention: its reply is late, or it is due."""
        pause_ns = watch.target.interval_ns
        if watch.waits:
            pause_ns = min(pause_ns, self._policy.answer_ns)
        elif watch.tracker.in_doubt:
            pause_ns = min(pause_ns, self._policy.retry_ns)
        due_ns = watch.probed_at_ns + pause_ns
        # An old heap entry stays and is ignored by its due_ns: removal from a heap costs more.
        if due_ns != watch.due_ns:
            watch.due_ns = due_ns
            heapq.heappush(self._heap, (due_ns, watch.target.name))
