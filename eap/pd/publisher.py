"""Sending side of one EAP port: frames that are due in a cycle, and answers to requests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

from eap.ids import NetId
from eap.pd.address import from_word, net_id_of, to_word
from eap.pd.compiledplan import fill_send_plan, make_send_plan
from eap.pd.image import Image, Inputs
from eap.pd.layout import FRAME_CTRL, VAR_CTRL, FrameSlot, TxSlot
from eap.pd.link import FrameChannel, OutFrame
from eap.pd.poll import PollRequests
from eap.pd.quality import NO_ORIGINS, Origins, forwarded_quality
from eap.pd.spec import TriggerSpec, TxFrameSpec
from eap.pd.txframe import (
    EVENT_BIT,
    SUPPRESS_BIT,
    Gather,
    Schedule,
    Selection,
    Trigger,
    TxFrame,
    TxPd,
    build_frame,
    plan_schedule,
)
from eap.pd.words import REASON_INDEX, FrameState, FrameWord, Reason, TxWord

FrameRow: TypeAlias = tuple[TxFrameSpec, FrameSlot, tuple[TxSlot, ...]]
"""A TxFrame with its place and the places of its PDs."""


# An unsent frame is entered with its time and never cleared, so that sending costs nothing more: a
# reader compares that time with the time of the last frame sent.
def enter_sent(words: memoryview, pd: TxSlot, reason: int, now_ns: int) -> None:
    """Enter that *pd* was sent on its own, for *reason* (an index into REASONS)."""
    first = pd.words
    words[first + TxWord.REASON + reason] += 1
    words[first + TxWord.LAST_REASON] = reason
    words[first + TxWord.SENT_AT_NS] = now_ns


def enter_skipped(words: memoryview, pds: Iterable[TxSlot], now_ns: int) -> None:
    """Enter that *pds* were due and not sent."""
    for pd in pds:
        words[pd.words + TxWord.SKIPPED] += 1
        words[pd.words + TxWord.UNSENT_AT_NS] = now_ns


def enter_suppressed(words: memoryview, frame: FrameSlot, now_ns: int) -> None:
    """Enter that *frame* was due and suppressed."""
    _enter_unsent(words, frame, FrameState.NOT_SENT, now_ns)


def enter_refused(words: memoryview, frame: FrameSlot, out: OutFrame, now_ns: int) -> None:
    """Enter that a channel did not send *out*, which is *frame* or a part of it."""
    oversized = FrameState.OVERSIZED if out.oversized else 0
    _enter_unsent(words, frame, FrameState.NOT_SENT | oversized, now_ns)


def _enter_unsent(words: memoryview, frame: FrameSlot, state: FrameState, now_ns: int) -> None:
    words[frame.words + FrameWord.SKIPPED] += 1
    words[frame.words + FrameWord.UNSENT] = state
    words[frame.words + FrameWord.UNSENT_AT_NS] = now_ns


class FrameGroup:
    """Frames that are sent whole, all in the same cycles: no decision is left but the cycle."""

    __slots__ = ("counters", "frames", "out", "patches", "phase", "step")

    def __init__(self, schedule: Schedule, frames: list[TxFrame]) -> None:
        self.step = schedule.step
        self.phase = schedule.phase
        self.frames = frames
        self.out = [frame.whole.out for frame in frames]
        self.patches = [frame.whole.patch for frame in frames]
        self.counters = [
            (frame.slot.words + FrameWord.WHOLE, frame.slot.words + FrameWord.SENT_AT_NS)
            for frame in frames
        ]


class Publisher:
    """Sends the frames of one port.

    Args:
        image: The station's process image.
        inputs: The variables as the cycle sees them.
        publisher: NetID of the port.
        channel: Destination of the frames; it defines the bytes before the EtherCAT header.
        frames: The port's TxFrames, each with its place and the places of its PDs.
        origins: Subscriptions from which its variables get their values.
    """

    def __init__(
        self,
        image: Image,
        inputs: Inputs,
        publisher: NetId,
        channel: FrameChannel,
        frames: Iterable[FrameRow],
        origins: Origins = NO_ORIGINS,
    ) -> None:
        self._image = image
        self._inputs = inputs
        self._words = image.words
        self.wanted: dict[bytes, list[TxFrame]] = {}
        """Frames that go to a NetID, by that NetID: :meth:`learn` wants its address."""
        cycle_us = image.layout.cycle_us
        self.frames: list[TxFrame] = []
        for spec, slot, slots in frames:
            gate = (spec.divider, spec.modulo)
            pds = tuple(
                TxPd(
                    where,
                    Trigger(pd.trigger, plan_schedule(pd.trigger, cycle_us, gate)),
                    Gather(image, inputs, pd.variables),
                    forwarded_quality(image, pd.variables, origins),
                )
                for pd, where in zip(spec.pds, slots, strict=True)
            )
            destination = spec.mac or spec.destination
            net_id = net_id_of(destination)
            if net_id is not None:  # what an earlier engine learned will do until it is heard anew
                destination = str(from_word(self._words[slot.words + FrameWord.ADDRESS]) or "")
            frame = TxFrame(slot, publisher, pds, gate, channel, destination, is_signed=spec.sign)
            self.frames.append(frame)
            self._note_target(frame, net_id)
        self._controls: dict[str, int] = {}
        self.plan = make_send_plan(image.words)
        """Frames that the compiled part sends: all or none; None without it."""
        self._groups: list[FrameGroup] = []
        self._due: list[FrameGroup] = []
        self._others: list[TxFrame] = []
        self._sending: list[tuple[TxFrame, Selection]] = []
        self.read_controls()

    def learn(self, net_id: bytes, destination: str) -> None:
        """Send what goes to *net_id* to *destination*, where its frames come from."""
        changed = [frame for frame in self.wanted[net_id] if frame.destination != destination]
        for frame in changed:
            frame.retarget(destination)
            self._note_address(frame)
        if changed:
            self._group_frames()

    def _note_target(self, frame: TxFrame, net_id: NetId | None) -> None:
        if net_id is not None:
            self.wanted.setdefault(net_id, []).append(frame)
        self._note_address(frame)

    def _note_address(self, frame: TxFrame) -> None:
        self._words[frame.slot.words + FrameWord.ADDRESS] = to_word(frame.destination)

    def read_controls(self) -> None:
        """Follow the control variables; called when the application has written."""
        for frame in self.frames:
            control = read_control(self._image, self._inputs, frame.slot.name + FRAME_CTRL)
            frame.suppressed = bool(control & SUPPRESS_BIT)
            for pd in frame.pds:
                name = pd.slot.name + VAR_CTRL
                control = read_control(self._image, self._inputs, name)
                before = self._controls.get(name, control)  # a bit left set is no rising bit
                self._controls[name] = control
                pd.trigger.suppressed = bool(control & SUPPRESS_BIT)
                if control & ~before & EVENT_BIT and pd.trigger.accepts_events:
                    pd.trigger.raise_event()
        self._group_frames()

    def _group_frames(self) -> None:
        """Sort out the frames that need no decision."""
        # Frames with one schedule need one comparison a cycle for all of them.
        plain: dict[Schedule, list[TxFrame]] = {}
        for frame in self.frames:
            if frame.is_plain and frame.schedule is not None:
                plain.setdefault(frame.schedule, []).append(frame)
        self._groups = [FrameGroup(schedule, frames) for schedule, frames in plain.items()]
        self._others = [frame for frame in self.frames if not frame.is_plain]
        if self.plan is not None:
            self.plan.clear()
            if not self._others:
                fill_send_plan(self.plan, self._groups)

    def forget(self) -> None:
        """Reset the triggers: on-change PDs are due at once, and no event is pending.

        The station calls it when it begins to send again (PreOp to SafeOp); a new publisher is so.
        """
        for frame in self.frames:
            for pd in frame.pds:
                pd.trigger.forget()

    def follow(self, before: Publisher) -> None:
        """Continue with the triggers of the PDs that *before* sent too."""
        then = dict(before.remembering())
        for name, (content, trigger) in self.remembering():
            if name in then:
                sent, was = then[name]
                trigger.follow(was, is_same=sent == content)
        for name in self._controls.keys() & before._controls.keys():
            self._controls[name] = before._controls[name]
        self.learn_from(before)
        for frame in self.frames:
            self._note_address(frame)

    def learn_from(self, before: Publisher) -> None:
        """Adopt the addresses behind NetIDs that *before* has learned."""
        for net_id in self.wanted.keys() & before.wanted.keys():
            if destination := before.wanted[net_id][0].destination:
                self.learn(net_id, destination)

    def remembering(self) -> Iterator[tuple[str, tuple[tuple[object, ...], Trigger]]]:
        """Yield the PDs that are not sent by schedule alone: content, destination and trigger."""
        for frame in self.frames:
            for pd in frame.pds:
                if not pd.slot.by_schedule:
                    slot = pd.slot
                    content = slot.pd_id, slot.version, slot.variables, frame.slot.destination
                    yield slot.name, (content, pd.trigger)

    def release(self) -> None:
        """Free all frames one by one: freeing many at once would delay the cycles."""
        if self.plan is not None:
            self.plan.clear()
        for container in (self._groups, self._due, self._others, self._sending):
            container.clear()
        while self.frames:
            self.frames.pop()

    def frames_to_send(self, cycle: int, now_ns: int) -> list[OutFrame]:
        """Return the frames due in this cycle, patched; :meth:`sent` must follow."""
        self._due = due = [group for group in self._groups if cycle % group.step == group.phase]
        for group in due:
            for patch in group.patches:
                patch(cycle)
        self._sending.clear()
        if self._others:
            self._select_others(cycle, now_ns)
        elif len(due) == 1:
            return due[0].out
        frames = [out for group in due for out in group.out]
        return frames + [selection.out for _, selection in self._sending]

    def _select_others(self, cycle: int, now_ns: int) -> None:
        """Select and patch the frames that need a decision, and note them as being sent."""
        for frame in self._others:
            chosen, skipped = frame.select(cycle, now_ns)
            if skipped:
                self._skip(frame, skipped, now_ns)
            if chosen is not None:
                chosen.patch(cycle)
                self._sending.append((frame, chosen))

    def sent(self, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count the frames sent since :meth:`frames_to_send`, all but *failed*.

        Change and event triggers of PDs that the network did not take try again in the next cycle.
        """
        words, due, sending = self._words, self._due, self._sending
        if failed:  # then each frame has to be looked at by itself
            sending = sending + [(frame, frame.whole) for group in due for frame in group.frames]
            due = []
        for group in due:
            for whole, sent_at in group.counters:
                words[whole] += 1
                words[sent_at] = now_ns
        for frame, selection in sending:
            if failed and selection.out in failed:
                enter_refused(words, frame.slot, selection.out, now_ns)
                enter_skipped(words, (pd.slot for pd in selection.pds), now_ns)
                continue
            first = frame.slot.words
            words[first + FrameWord.SENT_AT_NS] = now_ns
            if frame.schedule is not None and selection is frame.whole:
                words[first + FrameWord.WHOLE] += 1
            else:
                words[first + FrameWord.PARTIAL] += 1
                self._count(selection, now_ns)

    def sent_partly(self, cycle: int, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count the frames of :attr:`plan` that were due, all but *failed*."""
        self._due = [group for group in self._groups if cycle % group.step == group.phase]
        self._sending.clear()
        self.sent(failed, now_ns)

    def _count(self, selection: Selection, now_ns: int) -> None:
        for pd in selection.pds:
            enter_sent(self._words, pd.slot, pd.reason, now_ns)
            pd.trigger.sent(pd.reason, now_ns, pd.data)

    def _skip(self, frame: TxFrame, pds: Sequence[TxPd], now_ns: int) -> None:
        if frame.is_held:
            enter_suppressed(self._words, frame.slot, now_ns)
        enter_skipped(self._words, (pd.slot for pd in pds), now_ns)
        for pd in pds:
            if frame.suppressed or pd.trigger.suppressed:  # else it waits for the address
                # An event that was suppressed is over: it must not be sent when the suppression
                # ends.
                pd.trigger.clear_event()


def read_control(image: Image, inputs: Inputs, name: str) -> int:
    """Return the control variable *name* as this cycle sees it."""
    slot = image.slots[name]
    return int.from_bytes(inputs.memory[slot.bit_offset // 8 :][:2], "little")


ANSWERS_KEPT = 64
"""Buffers of a frame for the latest requesters; another one costs building a buffer."""
_POLL = REASON_INDEX[Reason.POLL]


class _ResponseFrame:
    """The polled PDs of one TxFrame, and a buffer for each requester."""

    def __init__(self, slot: FrameSlot, pds: tuple[TxPd, ...], *, is_signed: bool) -> None:
        self.slot = slot
        self.pds = pds
        self._is_signed = is_signed
        self.suppressed = False
        self._kept: dict[tuple[str, tuple[TxPd, ...]], Selection] = {}

    def select(
        self, sender: str, pds: tuple[TxPd, ...], publisher: NetId, channel: FrameChannel
    ) -> Selection:
        """Return the buffer for *pds* to *sender*."""
        kept = self._kept
        selection = kept.get((sender, pds))
        if selection is None:
            if len(kept) >= ANSWERS_KEPT:
                # The oldest goes; requesters may forge addresses, so the table has to stay bounded.
                del kept[next(iter(kept))]
            out = build_frame(publisher, pds, channel, sender, is_signed=self._is_signed)
            selection = Selection(out, pds)
            kept[sender, pds] = selection
        return selection


class PollResponder:
    """Sends the polled PDs of one port to their requesters.

    All polled PDs of a TxFrame that one sender requested go to it in one frame.

    Args:
        image: The station's process image.
        inputs: The variables as the cycle sees them.
        publisher: NetID of the port.
        channel: Sends the answers.
        frames: The TxFrames with their polled PDs.
        requests: Pending requests by sender.
        origins: Subscriptions from which its variables get their values.
    """

    plan = None

    def __init__(
        self,
        image: Image,
        inputs: Inputs,
        publisher: NetId,
        channel: FrameChannel,
        frames: Iterable[FrameRow],
        requests: PollRequests,
        origins: Origins = NO_ORIGINS,
    ) -> None:
        self._image = image
        self._inputs = inputs
        self._publisher = publisher
        self._channel = channel
        self._requests = requests
        self._frames = [
            _ResponseFrame(
                slot,
                tuple(
                    TxPd(
                        where,
                        Trigger(TriggerSpec(), None),
                        Gather(image, inputs, pd.variables),
                        forwarded_quality(image, pd.variables, origins),
                    )
                    for pd, where in zip(spec.pds, slots, strict=True)
                ),
                is_signed=spec.sign,
            )
            for spec, slot, slots in frames
        ]
        self._sending: list[tuple[_ResponseFrame, Selection]] = []
        self.read_controls()

    def read_controls(self) -> None:
        """Follow the control variables; called when the application has written."""
        for frame in self._frames:
            control = read_control(self._image, self._inputs, frame.slot.name + FRAME_CTRL)
            frame.suppressed = bool(control & SUPPRESS_BIT)
            for pd in frame.pds:
                control = read_control(self._image, self._inputs, pd.slot.name + VAR_CTRL)
                pd.trigger.suppressed = bool(control & SUPPRESS_BIT)

    def frames_to_send(self, cycle: int, now_ns: int) -> list[OutFrame]:
        """Return the answers to all pending requests, patched; :meth:`sent` must follow."""
        self._sending.clear()
        for sender, names in self._requests.pop_all().items():
            for frame in self._frames:
                due = [pd for pd in frame.pds if pd.slot.poll_request in names]
                chosen = tuple(p for p in due if not (frame.suppressed or p.trigger.suppressed))
                if len(chosen) < len(due):
                    self._skip(frame, [pd.slot for pd in due if pd not in chosen], now_ns)
                if chosen:
                    selection = frame.select(sender, chosen, self._publisher, self._channel)
                    selection.patch(cycle)
                    self._sending.append((frame, selection))
        return [selection.out for _, selection in self._sending]

    def sent(self, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count what was sent since :meth:`frames_to_send`, all but *failed*."""
        words = self._image.words
        for frame, selection in self._sending:
            if failed and selection.out in failed:
                enter_refused(words, frame.slot, selection.out, now_ns)
                enter_skipped(words, (pd.slot for pd in selection.pds), now_ns)
                continue
            words[frame.slot.words + FrameWord.SENT_AT_NS] = now_ns
            words[frame.slot.words + FrameWord.PARTIAL] += 1
            for pd in selection.pds:
                enter_sent(words, pd.slot, _POLL, now_ns)

    def _skip(self, frame: _ResponseFrame, pds: Iterable[TxSlot], now_ns: int) -> None:
        if frame.suppressed:
            enter_suppressed(self._image.words, frame.slot, now_ns)
        enter_skipped(self._image.words, pds, now_ns)
