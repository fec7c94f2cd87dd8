"""Receiving side of one EAP port: accepts PDs of frames, and counts dropped PDs by reason.

No frame of a publisher raises an exception: a dropped PD is counted under its reason.  Data goes
from the frame straight into the process image; state and counters live there too.
"""

from __future__ import annotations

import struct
import weakref
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import CYCLE_OFFSET, EAP_SM_OFFSET, FIRST_PD, PD_FRAME_START, PdHeader
from eap.ids import NetId
from eap.pd import ordering
from eap.pd.address import NetIdLearner, SourceWatch
from eap.pd.authentication import (
    SIGNATURE_FAULTS,
    KeyRing,
    SignatureCheck,
    find_signature,
    is_signature,
)
from eap.pd.compiledplan import compile_handler
from eap.pd.image import Image
from eap.pd.layout import RxSlot
from eap.pd.link import FrameHandler, FrameOrigin
from eap.pd.poll import OutgoingPoll, PollRequests
from eap.pd.sequence import SequenceTracker, Timing
from eap.pd.spec import Authentication, RxPdSpec
from eap.pd.subscription import (
    AcceptedPd,
    DroppedPd,
    FrameHead,
    FramePlan,
    RxSubscription,
    Signature,
    SubstituteValue,
    walk,
    walk_by_pds,
)
from eap.pd.words import PD_DROP_INDEX, PdDropReason, RxWord, StationWord

_KEY = struct.Struct("<10s3x7s").unpack_from
"""EtherCAT header, publisher and count; EAP SM and the header of the first PD: key of a layout.

With one PD in the frame nothing else has to be compared.
"""
_SHORTEST = FIRST_PD + PdHeader.SIZE
"""Minimum size of a frame with a PD."""
_CYCLE_COUNTER = struct.Struct("<H").unpack_from
_PDS_PLANNED = 16384
"""Limit of PDs in all plans: a plant has fewer, and forged frames must not exhaust memory."""
_PLANS_PER_KEY = 16
"""Limit of layouts with one key, which are tried in turn; beyond it all are learned again."""
_NEVER = 1 << 62
NO_KEYS = KeyRing()

_CYCLE = int(StationWord.CYCLE)
_SEQUENCE = int(StationWord.ENGINE_SEQUENCE)


def _no_handler() -> None:
    """Return no compiled handler."""


class Subscriber:
    """Takes the frames of one port.

    Channels hand their frames to it as long as the port exists; the subscriptions may be replaced
    by others, with the image that they are in.

    Args:
        image: The station's process image.
        subscriptions: The port's RxPDs, each with its place.
        own_cycle_ns: The station's device cycle.
        requests: Table for the requests of others.
        polls: The station's own polls, by the TxPD that sends them.
        lenient: Whether frames with a wrong Length are taken.
        keys: Keys of the station, for signed frames.
    """

    def __init__(
        self,
        image: Image,
        subscriptions: Iterable[tuple[RxPdSpec, RxSlot]],
        own_cycle_ns: int,
        requests: PollRequests,
        polls: Mapping[str, OutgoingPoll] = MappingProxyType({}),
        *,
        lenient: bool = False,
        keys: KeyRing = NO_KEYS,
    ) -> None:
        self._compiled: Callable[[], Any] = _no_handler
        self._table = SubscriptionTable(
            image, subscriptions, own_cycle_ns, requests, polls, lenient=lenient, keys=keys
        )
        self._open_from_ns = _NEVER
        self._closed_reason = PdDropReason.SUPPRESSED
        self._next_timeout_ns = _NEVER

    def make_handler(self, learner: NetIdLearner | None = None) -> FrameHandler:
        """Return the handler of the port's frames: the compiled part, with Python behind it.

        Args:
            learner: Looks at the frames first, and hands them to :meth:`receive_frame`.
        """
        handle = self.receive_frame if learner is None else learner.handle
        compiled: FrameHandler | None = compile_handler(handle, learner)
        if compiled is None:
            return handle
        # A reference to what refers to this object would make a cycle, which is never freed as
        # long as the collector is off.
        self._compiled = weakref.ref(compiled)
        self._follow()
        return compiled

    def open(self, from_ns: int) -> None:
        """Take what arrives from now on; what arrived earlier is stale (the station is in Op)."""
        self._open_from_ns = from_ns
        self._follow()
        self._closed_reason = PdDropReason.STALE
        self._next_timeout_ns = from_ns

    def resume(self, from_ns: int) -> None:
        """Take what arrives from now on, after :meth:`close`; nothing was missed meanwhile."""
        for tracker in {subscription.tracker for subscription in self._table.subscriptions}:
            tracker.pause()
        self.open(from_ns)

    def close(self) -> None:
        """Stop receiving: the station left Op."""
        self._open_from_ns = _NEVER
        self._follow()
        self._closed_reason = PdDropReason.SUPPRESSED
        self._next_timeout_ns = _NEVER

    def _follow(self) -> None:
        """Have the compiled handler use the present table and time."""
        handler, table = self._compiled(), self._table
        if handler is not None:
            handler.open_from_ns = self._open_from_ns
            handler.attach(table.plans, table.memory, table.words)

    def learn_from(self, before: Subscriber) -> None:
        """Plan for all layouts of frames that *before* knows, so that none is new."""
        self._table.learn_from(before._table)

    def swap_in(self, after: Subscriber, now_ns: int) -> None:
        """Exchange the subscriptions with those of *after*.

        Whether this one is open stays as it is.
        """
        self._table, after._table = after._table, self._table
        self._follow()
        after._follow()
        if self._open_from_ns != _NEVER:
            # What is new, or has another time-out now, has at least that long.
            following_ns = now_ns + self._table.shortest_timeout_ns
            self._next_timeout_ns = min(self._next_timeout_ns, following_ns)

    def release(self) -> None:
        """Free all subscriptions one by one."""
        if (handler := self._compiled()) is not None:
            handler.detach()
        self._table.release()

    def receive_frame(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> None:
        """Take one EtherCAT frame of *size* bytes that arrived at *at_ns* from *origin*."""
        source = origin.source_of(data)
        table = self._table
        # A layout is walked once; the same layout of the same publisher then costs one lookup.
        plan = table.find_plan(data, size, source, at_ns) or table.learn(data, size, source, at_ns)
        if plan is None:
            return
        if at_ns < self._open_from_ns:
            table.discard(self._closed_reason, len(plan.expected), plan.accepted_words)
            return
        if plan.has_checks:
            plan = plan.admit(data)
        words, memory = table.words, table.memory
        # A frame taken outside the station's own cycle has to mark the region as changing itself.
        outside = not words[_SEQUENCE] & 1
        if outside:
            words[_SEQUENCE] += 1
            ordering.keep_order()
        (cycle,) = _CYCLE_COUNTER(data, CYCLE_OFFSET)
        # Outside of a cycle the data counts as that of the next one, which is the first to use it.
        own_cycle = words[_CYCLE] + outside
        for tracker, copies in plan.parts:
            if tracker.arrived(cycle, at_ns, own_cycle):
                for piece, target in copies:
                    memory[target] = data[piece]
        if plan.has_more:
            plan.copy_alternates(data, cycle, memory)
            table.refuse(plan, at_ns)
            table.enter_answers(plan, cycle, at_ns)
            table.note_requests(plan, cycle, data, origin)
            plan.enter_toggle(cycle)
        if outside:
            ordering.keep_order()
            words[_SEQUENCE] += 1

    @property
    def has_timeouts(self) -> bool:
        """True if any subscription has one: otherwise handle_timeout() need not be called."""
        return self._table.shortest_timeout_ns != _NEVER

    def next_timeout(self) -> int | None:
        """Return when handle_timeout() has to be called, None for never."""
        return None if self._next_timeout_ns == _NEVER else self._next_timeout_ns

    def handle_timeout(self, now_ns: int) -> None:
        """Apply the substitute of every subscription whose data is too old; early calls do no harm.

        Called in each cycle; it looks at the subscriptions only when one can have timed out.
        """
        if now_ns < self._next_timeout_ns:
            return
        following = _NEVER
        expired: dict[SequenceTracker, list[RxSubscription]] = {}
        for subscription in self._table.subscriptions:
            timeout_ns, tracker = subscription.timeout_ns, subscription.tracker
            if not timeout_ns:
                continue
            if not tracker.is_running:
                # It may start to run at any moment, and then has this long.
                following = min(following, now_ns + timeout_ns)
                continue
            deadline_ns = subscription.deadline_ns()
            if deadline_ns is None:
                # A polled PD that is not requested cannot be late; its time runs from the next
                # request.
                following = min(following, now_ns + timeout_ns)
            elif deadline_ns <= now_ns:
                # A tracker is shared: its time-out counts once, for all its subscriptions.
                expired.setdefault(tracker, []).append(subscription)
                following = min(following, now_ns + timeout_ns)
            else:
                following = min(following, deadline_ns)
        for tracker, subscriptions in expired.items():
            tracker.time_out()
            for subscription in subscriptions:
                subscription.substitute.apply()
        self._next_timeout_ns = following


ChosenPd: TypeAlias = tuple[RxSubscription, PdHeader, int]
"""A subscription that accepts a PD of a frame, and the PD's header with its offset."""


class _LearnedLayout(NamedTuple):
    """A layout of frames and what becomes of its PDs; see :class:`FramePlan`."""

    head: FrameHead
    end: int
    pds: list[tuple[bytes, int]]
    chosen: list[ChosenPd]
    refused: list[DroppedPd]
    watch: SourceWatch


class SubscriptionTable:
    """The subscriptions of a port in one image, and the plans of the frames that come for them.

    Arguments as for :class:`Subscriber`.

    Attributes:
        memory: Of the image.
        words: Of the image.
        plans: Of all layouts that are known, by key.
        subscriptions: All of them.
        shortest_timeout_ns: Of theirs; never if they have none.
    """

    def __init__(
        self,
        image: Image,
        subscriptions: Iterable[tuple[RxPdSpec, RxSlot]],
        own_cycle_ns: int,
        requests: PollRequests,
        polls: Mapping[str, OutgoingPoll],
        *,
        lenient: bool = False,
        keys: KeyRing = NO_KEYS,
    ) -> None:
        self._requests = requests
        self._lenient = lenient
        self._keys = keys
        self.memory = image.memory
        self.words = image.words
        self.subscriptions = [
            RxSubscription(spec, slot, SubstituteValue(image, slot), polls.get(spec.poll_request))
            for spec, slot in subscriptions
        ]
        self._by_key: dict[tuple[bytes, int], list[RxSubscription]] = {}
        self._by_id: dict[int, list[RxSubscription]] = {}
        for subscription in self.subscriptions:
            slot = subscription.slot
            publisher = NetId.parse(slot.publisher) if slot.publisher else b""
            self._by_key.setdefault((publisher, slot.pd_id), []).append(subscription)
            self._by_id.setdefault(slot.pd_id, []).append(subscription)
        timeouts = [s.timeout_ns for s in self.subscriptions if s.timeout_ns]
        self.shortest_timeout_ns = min(timeouts, default=_NEVER)
        self._sources = frozenset(s.source for s in self.subscriptions if s.source)
        self.plans: dict[tuple[bytes, bytes], list[FramePlan]] = {}
        self._watches: dict[tuple[bytes, bytes], SourceWatch] = {}
        self._pds_planned = 0
        self._open_trackers(own_cycle_ns)

    def learn_from(self, before: SubscriptionTable) -> None:
        """Plan for all layouts of frames that *before* knows, so that none is new."""
        # Copies: the running cycle may learn a layout while the thread that rebuilds reads the
        # tables.
        for plans in list(before.plans.values()):
            for plan in list(plans):
                if plan.has_wrong_length and not self._lenient:
                    continue  # learning it would count a dropped frame that never came
                self.learn(plan.example(), plan.end, plan.watch.source or b"", 0)

    def release(self) -> None:
        """Free all subscriptions one by one: freeing many at once would delay the cycles."""
        for container in (self._by_key, self._by_id, self.plans, self._watches):
            while container:
                container.popitem()
        while self.subscriptions:
            self.subscriptions.pop()

    def find_plan(self, data: memoryview, size: int, source: bytes, at_ns: int) -> FramePlan | None:
        """Return the plan of a frame's layout, None if it is not known yet."""
        if size >= _SHORTEST:
            for plan in self.plans.get(_KEY(data), ()):
                if plan.end <= size and (
                    plan.is_single or plan.headers(data, FIRST_PD) == plan.expected
                ):
                    watch = plan.watch
                    if source == watch.source or watch.includes(source, at_ns):
                        return plan
        return None

    def learn(self, data: memoryview, size: int, source: bytes, at_ns: int) -> FramePlan | None:
        """Make the plan of a layout not seen before from *source*, None without PDs."""
        pds = walk(data, size)
        is_wrong = isinstance(pds, PdDropReason)
        if isinstance(pds, PdDropReason):
            reason = pds
            pds = walk_by_pds(data, size) if self._lenient else []
            if not pds:
                self.discard(reason, 1)
                return None
        if not pds:
            return None  # nothing to take: what is kept is bounded by the PDs of all layouts
        publisher = bytes(data[PD_FRAME_START : PD_FRAME_START + 6])
        chosen, refused = self._choose(publisher, pds, source)
        taking = [subscription for subscription, _, _ in chosen]
        head = FrameHead(publisher, EtherCatHeader.decode(data).length, data[EAP_SM_OFFSET])
        end = PD_FRAME_START + head.length
        if is_wrong:
            end = pds[-1][1] + PdHeader.SIZE + pds[-1][0].length
            refused.append(_taken_though(PdDropReason.WRONG_LENGTH, taking))
        if self._part_trackers(set(taking)):
            # Plans hold trackers, so those made before the split are no longer valid.
            self._forget_plans()
        layout = _LearnedLayout(
            head,
            end,
            [(bytes(data[offset : offset + 6]), header.length) for header, offset in pds],
            chosen,
            refused,
            self._watch(publisher, source, at_ns, taking, refused),
        )
        plan = self._plan_checked(layout, find_signature(pds))
        if self._pds_planned > _PDS_PLANNED:
            self._forget_plans()
        self._pds_planned += (1 + len(pds)) * plan.alternatives
        same_key = self.plans.setdefault(_KEY(data), [])
        # Bounded: a sender could otherwise fill the memory with invented layouts.
        if len(same_key) >= _PLANS_PER_KEY:
            same_key.clear()
        same_key.append(plan)
        return plan

    def _choose(
        self, publisher: bytes, pds: Iterable[tuple[PdHeader, int]], source: bytes
    ) -> tuple[list[ChosenPd], list[DroppedPd]]:
        """Return the subscriptions that accept each PD, and counters of PDs that none accepts."""
        chosen: list[ChosenPd] = []
        refused = []
        for header, offset in pds:
            match = self._match(publisher, header, source)
            if not isinstance(match, DroppedPd):
                chosen += [(subscription, header, offset) for subscription in match]
            elif match is not _UNKNOWN_ID or not is_signature(header):
                refused.append(match)
        return chosen, refused

    def _plan_checked(self, layout: _LearnedLayout, signature: int | None) -> FramePlan:
        """Return the plan of *layout*, whose signature is at *signature* if it has one."""
        checked = [each for each, _, _ in layout.chosen if each.auth is not Authentication.OFF]
        if not checked:
            return self._plan(layout)
        if signature is None:
            return self._plan_without(layout, checked, PdDropReason.UNSIGNED)
        counters = [each.slot.words + RxWord.SIGNED for each in checked]
        check = SignatureCheck(self._keys, signature, self.words, counters)
        refusing = {fault: self._plan_without(layout, checked, fault) for fault in SIGNATURE_FAULTS}
        return self._plan(layout, (check, refusing))

    def _plan_without(
        self, layout: _LearnedLayout, checked: Iterable[RxSubscription], fault: PdDropReason
    ) -> FramePlan:
        """Return the plan of frames with *fault*, which all *checked* count and some refuse."""
        required = Authentication.REQUIRED
        chosen = [each for each in layout.chosen if each[0].auth is not required]
        refused = [*layout.refused, _taken_though(fault, checked)]
        return self._plan(layout._replace(chosen=chosen, refused=refused))

    def _plan(self, layout: _LearnedLayout, signature: Signature | None = None) -> FramePlan:
        taking = [subscription for subscription, _, _ in layout.chosen]
        return FramePlan(
            layout.head,
            layout.end,
            layout.pds,
            [_take(subscription, header, offset) for subscription, header, offset in layout.chosen],
            layout.refused,
            watch=layout.watch,
            requests=[
                (s.tracker, s.slot.name) for s in taking if s.slot.name in self._requests.names
            ],
            answers=[(s.tracker, s.answer) for s in taking if s.answer is not None],
            any_publisher={s.tracker for s in taking if not s.slot.publisher},
            signature=signature,
        )

    def _watch(
        self,
        publisher: bytes,
        source: bytes,
        at_ns: int,
        taking: Iterable[RxSubscription],
        refused: Iterable[DroppedPd],
    ) -> SourceWatch:
        """Return the watch over the frames of *publisher* with the class of *source*."""
        # Addresses without a subscription share one watch: a sender that forges them makes no new
        # ones.
        expected = source if source in self._sources else b""
        watch = self._watches.get((publisher, expected))
        if watch is None:
            watch = SourceWatch(self.words, expected, self._sources)
            self._watches[publisher, expected] = watch
        if source != watch.source:
            watch.includes(source, at_ns)
        watch.follow(
            (subscription.slot.words for subscription in taking),
            (first for pd in refused for first in pd.wrong_source),
        )
        return watch

    def _forget_plans(self) -> None:
        self.plans.clear()
        self._watches.clear()
        self._pds_planned = 0

    def _match(
        self, publisher: bytes, header: PdHeader, source: bytes
    ) -> list[RxSubscription] | DroppedPd:
        """Return the subscriptions that accept a PD, or the counters of a dropped one."""
        pd_id = header.pd_id
        # All that fit take the PD: two subscriptions may map one PD to variables of their own.
        candidates = self._by_key.get((publisher, pd_id), []) + self._by_key.get((b"", pd_id), [])
        if not candidates:
            others = self._by_id.get(pd_id, [])
            return _drop_all([(other, PdDropReason.WRONG_PUBLISHER) for other in others])
        mismatches = [(c, c.mismatch(header.version, header.length, source)) for c in candidates]
        fitting = [candidate for candidate, reason in mismatches if reason is None]
        return fitting or _drop_all([(c, reason) for c, reason in mismatches if reason is not None])

    def discard(self, reason: PdDropReason, count: int, subscriptions: Iterable[int] = ()) -> None:
        """Count *count* PDs under *reason*, for the station and for *subscriptions*."""
        index = PD_DROP_INDEX[reason]
        self.words[StationWord.DISCARDED + index] += count
        for first_word in subscriptions:
            self.words[first_word + RxWord.DISCARDED + index] += 1

    def refuse(self, plan: FramePlan, at_ns: int) -> None:
        """Count the PDs of a frame that no subscription takes."""
        words = self.words
        for pd in plan.refused:
            for counter in pd.counters:
                words[counter] += 1
            for first_word, bit in pd.mismatches:
                words[first_word + RxWord.MISMATCH] = bit
                words[first_word + RxWord.MISMATCH_AT_NS] = at_ns
            for first_word in pd.wrong_source:
                words[first_word + RxWord.WRONG_SOURCE_AT_NS] = at_ns

    def enter_answers(self, plan: FramePlan, cycle: int, at_ns: int) -> None:
        """Enter how long the answers in a frame took."""
        entered: set[SequenceTracker] = set()
        for tracker, answer in plan.answers:
            # An older frame than the last one was dropped, and answers nothing.
            if not tracker.has_taken(cycle):
                continue
            response_ns = answer.poll.enter_answer(answer.name, at_ns)
            self.words[answer.words + RxWord.RESPONSE_NS] = response_ns or 0
            if response_ns is not None and tracker not in entered:
                entered.add(tracker)
                tracker.enter_response(response_ns)

    def note_requests(
        self, plan: FramePlan, cycle: int, data: memoryview, origin: FrameOrigin
    ) -> None:
        """Note the requests in a frame, and their sender."""
        names = [name for tracker, name in plan.requests if tracker.has_taken(cycle)]
        if not names:
            return
        sender = origin.sender_of(data)
        # The data of the request was taken all the same; only its answer is missing.
        if not sender or not self._requests.add(sender, names):
            reason = PdDropReason.TOO_MANY_REQUESTS if sender else PdDropReason.NO_SENDER
            refused = [s.slot.words for s in self.subscriptions if s.slot.name in names]
            self.discard(reason, len(names), refused)

    def _open_trackers(self, own_cycle_ns: int) -> None:
        """Find the trackers that an earlier engine left in the image, or start new ones."""
        trackers: dict[object, SequenceTracker] = {}
        for subscription in self.subscriptions:
            slot = subscription.slot
            first_word = self.words[slot.words + RxWord.TRACKER]
            timing = Timing(
                step=slot.step,
                sender_cycle_ns=slot.sender_cycle_us * 1000,
                own_cycle_ns=own_cycle_ns,
                polled=bool(slot.poll_request),
            )
            # Only PDs with the same checks can share; with any publisher nothing is known.
            history: object = first_word or (
                (
                    slot.publisher,
                    slot.step,
                    slot.sender_cycle_us,
                    subscription.timeout_ns,
                    slot.poll_request,
                    subscription.auth,
                )
                if slot.publisher
                else slot.name
            )
            if history not in trackers:
                trackers[history] = SequenceTracker(self.words, first_word or slot.words, timing)
            self._assign(subscription, trackers[history])

    def _assign(self, subscription: RxSubscription, tracker: SequenceTracker) -> None:
        subscription.tracker = tracker
        self.words[subscription.slot.words + RxWord.TRACKER] = tracker.first_word

    def _part_trackers(self, arriving: set[RxSubscription]) -> bool:
        """Split a tracker if only some of its PDs arrive together."""
        parted = False
        for tracker in {subscription.tracker for subscription in arriving}:
            members = [s for s in self.subscriptions if s.tracker is tracker]
            here = [s for s in members if s in arriving]
            if len(here) == len(members):
                continue
            parted = True
            # The owner of the block keeps it; the others move to the block of their first.
            owner_arrives = any(s.slot.words == tracker.first_word for s in here)
            leaving = [s for s in members if s not in arriving] if owner_arrives else here
            new = tracker.part(self.words, leaving[0].slot.words)
            for subscription in leaving:
                self._assign(subscription, new)
        return parted


_UNKNOWN_ID = DroppedPd((StationWord.DISCARDED + PD_DROP_INDEX[PdDropReason.UNKNOWN_ID],))
_VAR_STATE = {PdDropReason.VERSION: 1, PdDropReason.LENGTH: 2}


def _take(subscription: RxSubscription, header: PdHeader, offset: int) -> AcceptedPd:
    """Return how *subscription* takes the PD with *header* at *offset* of the frame."""
    slot = subscription.slot
    alternate = subscription.alternates.get((header.version, header.length))
    size = PdHeader.SIZE + slot.size
    return AcceptedPd(subscription.tracker, slot.words, offset, slot.offset, size, alternate)


def _taken_though(reason: PdDropReason, concerned: Iterable[RxSubscription]) -> DroppedPd:
    """Count a frame under *reason*, and for the subscriptions that it concerns."""
    index = PD_DROP_INDEX[reason]
    words = dict.fromkeys(each.slot.words for each in concerned)
    counters = [StationWord.DISCARDED + index, *(each + RxWord.DISCARDED + index for each in words)]
    return DroppedPd(tuple(counters))


def _drop_all(reasons: list[tuple[RxSubscription, PdDropReason]]) -> DroppedPd:
    """Count a PD once for the station, and for each subscription under its own reason."""
    if not reasons:
        return _UNKNOWN_ID
    counters = [StationWord.DISCARDED + PD_DROP_INDEX[reasons[0][1]]]
    counters += [s.slot.words + RxWord.DISCARDED + PD_DROP_INDEX[why] for s, why in reasons]
    mismatches = [(s.slot.words, _VAR_STATE[why]) for s, why in reasons if why in _VAR_STATE]
    wrong_source = [s.slot.words for s, why in reasons if why is PdDropReason.WRONG_SOURCE]
    return DroppedPd(tuple(counters), tuple(mismatches), tuple(wrong_source))
