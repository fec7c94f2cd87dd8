"""Polled exchange: requests of other stations, and requests of this station.

A request is an ordinary PD and so is its answer (ETG.1005): what makes them so is configuration on
both sides.  An answer carries nothing of the request, so it belongs to the last one sent before.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from eap.pd.image import Image
from eap.pd.layout import TxSlot
from eap.pd.spec import StationSpec
from eap.pd.words import FrameWord, TxWord

REQUESTERS_PER_CYCLE = 32
"""Senders that one port answers in a cycle: each costs it a frame."""


class PollRequests:
    """Requests that came to one port since the last answers.

    Args:
        names: The RxPDs that are requests.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = frozenset(names)
        self._pending: dict[str, set[str]] = {}

    def add(self, sender: str, names: Iterable[str]) -> bool:
        """Note a request of *sender* with the RxPDs *names*; return False if the table is full."""
        pending = self._pending
        asked = pending.get(sender)
        if asked is None:
            if len(pending) >= REQUESTERS_PER_CYCLE:
                return False
            asked = pending[sender] = set()
        asked.update(names)
        return True

    def pop_all(self) -> dict[str, set[str]]:
        """Return the RxPDs that were received, by sender, and clear the table."""
        if not self._pending:
            return self._pending
        pending, self._pending = self._pending, {}
        return pending

    def follow(self, before: PollRequests) -> None:
        """Take over the requests of *before* that this port answers too."""
        # Requests that came just before a reconfiguration are answered by the new station.
        for sender, names in before.pop_all().items():
            if known := names & self.names:
                self.add(sender, known)


class OutgoingPoll:
    """One TxPD of this station that requests PDs of others.

    Args:
        words: The words of the station's image.
        slot: The TxPD.
        answers: The RxPDs that answer it.
    """

    __slots__ = ("_answers", "_before_ns", "_sent_at_ns", "_slot", "_state", "_waiting", "_words")

    def __init__(self, words: memoryview, slot: TxSlot, answers: Iterable[str]) -> None:
        self._words = words
        self._slot = slot
        self._answers = tuple(answers)
        self._sent_at_ns = 0
        self._before_ns = 0
        self._waiting: dict[str, int] = {}
        self._state = self._read_state()

    def follow(self, before: OutgoingPoll) -> None:
        """Continue the state of *before*; the words of the image have been carried over."""
        self._sent_at_ns, self._before_ns = before._sent_at_ns, before._before_ns
        self._waiting = {
            answer: at_ns for answer, at_ns in before._waiting.items() if answer in self._answers
        }
        self._state = self._read_state()

    def look(self, now_ns: int) -> None:
        """Note whether it was sent in the cycle that ends now and began at *now_ns*."""
        state = self._read_state()
        if state == self._state:
            return
        self._state = state
        self._before_ns, self._sent_at_ns = self._sent_at_ns, now_ns
        for answer in self._answers:
            # The first request without an answer counts: a time-out must not begin anew with each
            # request.
            self._waiting.setdefault(answer, now_ns)

    def requested_since(self, answer: str) -> int | None:
        """Return the time of the first request for *answer* since its arrival, None without one."""
        return self._waiting.get(answer)

    def enter_answer(self, answer: str, at_ns: int) -> int | None:
        """Enter that *answer* arrived at *at_ns*; return its response time, None without a request.

        What arrived before the last request, and is taken only now, answers the one before.
        """
        # An answer carries nothing of its request: it belongs to the last one sent before it.
        request_ns = self._sent_at_ns if at_ns >= self._sent_at_ns else self._before_ns
        if not 0 < request_ns <= at_ns:
            return None
        if request_ns == self._sent_at_ns:
            self._waiting.pop(answer, None)
        elif answer in self._waiting:
            self._waiting[answer] = self._sent_at_ns
        return at_ns - request_ns

    def _read_state(self) -> tuple[int, int]:
        words, slot = self._words, self._slot
        whole = words[slot.frame_words + FrameWord.WHOLE] if slot.by_schedule else 0
        return whole, words[slot.words + TxWord.SENT_AT_NS]


class PollAnswer(NamedTuple):
    """An RxPD that answers a poll."""

    name: str
    poll: OutgoingPoll
    words: int
    """Index of its first word."""


def requests_at(spec: StationSpec, port: str) -> PollRequests:
    """Return the table of requests for the polled PDs of *port*."""
    frames = [frame for frame in spec.frames if frame.port == port]
    return PollRequests(pd.poll_request for frame in frames for pd in frame.pds if pd.poll_request)


def outgoing_polls(image: Image) -> dict[str, OutgoingPoll]:
    """Return the polls of a station, by the TxPD that sends them."""
    answers: dict[str, list[str]] = {}
    for slot in image.layout.rx:
        if slot.poll_request:
            answers.setdefault(slot.poll_request, []).append(slot.name)
    return {
        slot.name: OutgoingPoll(image.words, slot, answers[slot.name])
        for slot in image.layout.tx
        if slot.name in answers
    }
