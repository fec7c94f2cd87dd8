"""Whether somebody is there: what answers, silence and hearsay make of it, round by round.

Rule 1: a round, from one question to the next, counts for one miss or one hit at most, however much
is heard in it.  Presence changes after several rounds that agree, or at once for what is certain.
Rule 2: nothing is present that was not seen.  Where nothing can be told, or nothing was for long,
the presence is unknown.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import NamedTuple

_SECOND_NS = 1_000_000_000


class Presence(IntEnum):
    """Whether the subscriber of a frame is there; the word of a frame in the process image."""

    UNKNOWN = 0
    PRESENT = 1
    MISSING = 2


class Evidence(Enum):
    """What one question, or something heard without one, says."""

    SEEN = auto()
    """It answered, or somebody who checks says that it is there."""
    MISSED = auto()
    """It did not answer this time."""
    ABSENT = auto()
    """Its host refuses what is sent, or somebody has already asked often enough, in vain."""
    PENDING = auto()
    """Nothing new; somebody is still asking."""
    BLIND = auto()
    """It cannot be told by this way."""


class PresencePolicy(NamedTuple):
    """How quickly to believe."""

    misses: int = 3
    """Rounds without an answer until it is missing, or rounds blind until it is unknown."""
    hits: int = 2
    """Rounds with an answer until what was missing is present; from unknown the first will do."""
    trust_ns: int = 15 * _SECOND_NS
    """How long what was told last holds when nothing new is, and at least *misses* intervals.

    More than the 8 s that a kernel with its usual settings takes to check a neighbour.
    """


DEFAULT_POLICY = PresencePolicy()


class Judge:
    """The presence of one subscriber, asked for every *interval_ns*."""

    def __init__(
        self, interval_ns: int, now_ns: int, policy: PresencePolicy = DEFAULT_POLICY
    ) -> None:
        self.presence = Presence.UNKNOWN
        self._policy = policy
        self._patience_ns = max(policy.trust_ns, policy.misses * interval_ns)
        self._told_at_ns = now_ns
        self._hits = self._misses = self._blind = 0
        self._verdict: Evidence | None = None  # of this round

    def begin_round(self) -> None:
        """Take note that somebody asks anew."""
        self._verdict = None

    @property
    def in_doubt(self) -> bool:
        """Whether the next round may change something: it had better come soon."""
        return bool(self._hits if self.presence is Presence.MISSING else self._misses)

    def take(self, evidence: Evidence, now_ns: int) -> Presence:
        """Count *evidence* and return the presence that follows."""
        before = self.presence
        match evidence:
            case Evidence.SEEN:
                self._hit(now_ns)
            case Evidence.MISSED | Evidence.ABSENT:
                self._miss(evidence, now_ns)
            case Evidence.BLIND:
                self._look_in_vain()
            case Evidence.PENDING:
                if now_ns - self._told_at_ns > self._patience_ns:
                    self.presence = Presence.UNKNOWN
        if self.presence is not before:
            self._hits = self._misses = self._blind = 0
        return self.presence

    def _hit(self, now_ns: int) -> None:
        self._told_at_ns = now_ns
        self._misses = self._blind = 0
        if self._verdict is not Evidence.SEEN:
            self._verdict = Evidence.SEEN
            self._hits += 1
        if self.presence is not Presence.MISSING or self._hits >= self._policy.hits:
            self.presence = Presence.PRESENT

    def _miss(self, evidence: Evidence, now_ns: int) -> None:
        if evidence is Evidence.MISSED and self._verdict is Evidence.SEEN:
            return
        self._told_at_ns = now_ns
        self._hits = self._blind = 0
        if self._verdict is not Evidence.MISSED:
            self._verdict = Evidence.MISSED
            self._misses += 1
        if evidence is Evidence.ABSENT or self._misses >= self._policy.misses:
            self.presence = Presence.MISSING

    def _look_in_vain(self) -> None:
        if self._verdict is None:
            self._verdict = Evidence.BLIND
            self._blind += 1
        if self._blind >= self._policy.misses:
            self.presence = Presence.UNKNOWN
