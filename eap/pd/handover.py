"""Handover of a process image to the one that replaces it: counters, trackers and values.

Rule 1: objects are matched by name.  Variables keep their value if their type is the same too, and
so do members of structs; frames and PDs keep their counters.
Rule 2: a tracker continues for all subscriptions that shared it, as long as they still may share
one.  A subscription to another publisher keeps its sums, and its tracker forgets the sender.
Rule 3: everything is planned beside running cycles; between two cycles, only bytes are copied.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

from msgspec.structs import asdict, replace

from eap.codec import datatypes
from eap.codec.datatypes import shared_parts
from eap.codec.pd import PdHeader
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.image import Image
from eap.pd.layout import ImageLayout, RxSlot
from eap.pd.monitor import SubscriberPresence
from eap.pd.spec import PortKind, PortSpec, StationSpec, Writer
from eap.pd.words import (
    REASON_INDEX,
    TRACKER_START,
    FrameWord,
    Reason,
    RxWord,
    StationWord,
    TxWord,
)

PORT_CONTENT = frozenset(("eap_sm", "length"))
"""Fields of a port that concern the content of its frames alone."""
_OF_ENGINE = PORT_CONTENT | {"net_id"}
"""Fields that its channels in the engine do not depend on."""
_OWN_WORDS = {
    StationWord.FUTEX,
    StationWord.ENGINE_SEQUENCE,
    StationWord.SERVICES_SEQUENCE,
    StationWord.APPLICATION_SEQUENCE,
    StationWord.RETIRED,
}
"""Words that belong to an image, and not to the station."""


_SOURCE_WORDS = (
    RxWord.SOURCE,
    RxWord.OTHER_SOURCE,
    RxWord.OTHER_SOURCE_AT_NS,
    RxWord.WRONG_SOURCE,
    RxWord.WRONG_SOURCE_AT_NS,
    RxWord.SIGNED,
)


class _WordRun(NamedTuple):
    """Words that are copied in one piece."""

    source: int
    target: int
    size: int


class ImageHandover:
    """Transfer of words and values from one image to the next one of the same station.

    Args:
        old: The image that is in use.
        new: A fresh one that is not in use yet.
        replaced: Names of the ports that are removed, or replaced by others.
    """

    def __init__(self, old: Image, new: Image, replaced: Collection[str] = ()) -> None:
        self._old, self._new = old, new
        station = [index for index in range(StationWord.SIZE) if index not in _OWN_WORDS]
        self._runs = _joined(_WordRun(index, index, 1) for index in station)
        self._sent = _Sent(old.layout, new.layout, replaced)
        self._received = _Received(old, new)
        self._from_engine, self._from_others = _plan_values(old, new)

    @property
    def is_current(self) -> bool:
        """True if subscriptions still share trackers as they did when this was planned."""
        return self._received.is_current

    def carry_words(self) -> None:
        """Copy the words of the station, of its frames, PDs and trackers."""
        old, new = self._old.words, self._new.words
        _copy(self._runs, old, new)
        new[StationWord.FUTEX] = new[StationWord.CYCLE] & 0xFFFFFFFF  # between two cycles
        self._sent.carry(old, new)
        self._received.carry(old, new)

    def carry_values(self, others: memoryview) -> None:
        """Copy the values of variables; in *others* lie those that the engine does not write.

        It is laid out as the old image.
        """
        self._from_engine.run(self._old.memory, self._new.memory)
        self._from_others.run(others, self._new.memory)

    def commit(self) -> None:
        """Adopt the trackers that the subscribers on the new image share."""
        self._received.commit()


class _Sent:
    """The words of TxFrames and TxPDs.

    The address of a frame is forgotten when its destination or its port changes; the presence of
    its subscriber then, too, and when it is monitored in another way.  A frame that is no more what
    it was gives the count of its cycles as a whole to its old PDs.
    """

    def __init__(self, old: ImageLayout, new: ImageLayout, replaced: Collection[str]) -> None:
        frames = {frame.name: frame for frame in old.frames}
        kept = [(frames[frame.name], frame) for frame in new.frames if frame.name in frames]
        self._changed = [
            b.words for a, b in kept if _schedules(old, a.name) != _schedules(new, b.name)
        ]
        # Another port may lead to another network, where hosts have other addresses.
        self._moved = [
            b.words for a, b in kept if a.destination != b.destination or b.port in replaced
        ]
        self._target_changed = [
            b.words for a, b in kept if a.target != b.target or b.port in replaced
        ]
        whole = {b.name for _, b in kept if b.words not in self._changed}
        before = {pd.name: pd for pd in old.tx}
        pds = [(before[pd.name], pd) for pd in new.tx if pd.name in before]
        self._split = [
            (was, pd.words)
            for was, pd in pds
            if was.by_schedule and not (was.frame == pd.frame and pd.frame in whole)
        ]
        self._runs = _joined(
            [_WordRun(was.words, frame.words, FrameWord.SIZE) for was, frame in kept]
            + [_WordRun(was.words, pd.words, TxWord.SIZE) for was, pd in pds]
        )

    def carry(self, old: memoryview, new: memoryview) -> None:
        """Copy them."""
        _copy(self._runs, old, new)
        for first in self._moved:
            new[first + FrameWord.ADDRESS] = 0
        for first in self._target_changed:
            new[first + FrameWord.PRESENCE] = SubscriberPresence.UNKNOWN
        for first in self._changed:
            new[first + FrameWord.PARTIAL] += new[first + FrameWord.WHOLE]
            new[first + FrameWord.WHOLE] = 0
        for was, first in self._split:
            count = old[was.frame_words + FrameWord.WHOLE]
            if count:
                # A PD without a trigger of its own does not count what it sends: its frame counts
                # for it. Outside of that frame the count has to become its own.
                reason = REASON_INDEX[Reason.CYCLE if was.cyclic else Reason.DIVIDER]
                new[first + TxWord.REASON + reason] += count
                new[first + TxWord.LAST_REASON] = reason
                own_ns = new[first + TxWord.SENT_AT_NS]
                frame_ns = old[was.frame_words + FrameWord.SENT_AT_NS]
                new[first + TxWord.SENT_AT_NS] = max(own_ns, frame_ns)


class _Received:
    """The words of RxPDs, and the trackers that they share."""

    def __init__(self, old: Image, new: Image) -> None:
        self._old, self._new = old.words, new.words
        self._old_column, self._new_column = _column(old.layout), _column(new.layout)
        self._shared: list[int] = old.words[self._old_column].tolist()
        before = {
            slot.name: (slot, tracker or slot.words)
            for slot, tracker in zip(old.layout.rx, self._shared, strict=True)
        }
        self._kept = [
            (index, *before[slot.name], slot)
            for index, slot in enumerate(new.layout.rx)
            if slot.name in before
        ]
        self._runs = _joined(
            _WordRun(was.words, slot.words, RxWord.SIZE) for _, was, _, slot in self._kept
        )
        self._owners = array("q", [0] * len(new.layout.rx))
        """By RxPD of the new image: where its tracker is, as in RxWord.TRACKER."""
        self._source_changed = [
            slot.words
            for _, was, _, slot in self._kept
            if (was.publisher, was.port, was.source) != (slot.publisher, slot.port, slot.source)
        ]
        first_of: dict[object, int] = {}
        for index, was, tracker, slot in self._kept:
            key = tracker, _sequence_restarts(was, slot), _tracker_key(slot)
            self._owners[index] = first_of.setdefault(key, slot.words)
        self._plan_trackers()

    @property
    def is_current(self) -> bool:
        return bool(self._old[self._old_column].tolist() == self._shared)

    def commit(self) -> None:
        self._owners = array("q", self._new[self._new_column].tolist())
        self._plan_trackers()

    def carry(self, old: memoryview, new: memoryview) -> None:
        """Copy them."""
        _copy(self._runs, old, new)
        _copy(self._trackers, old, new)
        new[self._new_column] = self._owners
        for first in self._restarted:
            new[first + RxWord.LAST_CYCLE] = -1
            # They describe the frames of the previous sender or rate, with which the next is not
            # compared.
            for word in (RxWord.BEHIND, RxWord.HOLES, RxWord.SENDER):
                new[first + word] = 0
        for first in self._source_changed:
            for word in _SOURCE_WORDS:
                new[first + word] = 0

    def _plan_trackers(self) -> None:
        sources: dict[int, int] = {}
        self._restarted: set[int] = set()
        for index, was, tracker, slot in self._kept:
            owner = self._owners[index]
            sources[owner] = tracker
            if _sequence_restarts(was, slot):
                self._restarted.add(owner)
        size = RxWord.SIZE - TRACKER_START
        self._trackers = [
            _WordRun(tracker + TRACKER_START, owner + TRACKER_START, size)
            for owner, tracker in sources.items()
        ]


def _schedules(layout: ImageLayout, frame: str) -> set[tuple[str, bool, bool]]:
    """Return the PDs that the count of a whole frame stands for, and their schedules."""
    return {(pd.name, pd.by_schedule, pd.cyclic) for pd in layout.tx if pd.frame == frame}


def _sequence_restarts(was: RxSlot, slot: RxSlot) -> bool:
    """Return whether the sequence restarts: the next frame cannot be compared with the last one.

    It comes from another sender, or from one that changes its rate: the gap between these
    two may be of the old rate or of the new one.
    """
    return (was.publisher, was.port, was.step) != (slot.publisher, slot.port, slot.step)


def _tracker_key(slot: RxSlot) -> tuple[object, ...]:
    """Return the properties that all subscriptions of a tracker share."""
    return (
        slot.port,
        slot.publisher,
        slot.step,
        slot.sender_cycle_us,
        slot.timeout_ms,
        slot.poll_request,
        slot.auth,
    )


def _column(layout: ImageLayout) -> slice:
    """Return the slice of RxWord.TRACKER of all RxPDs, whose blocks are adjacent."""
    if not layout.rx:
        return slice(0, 0)
    first = layout.rx[0].words + RxWord.TRACKER
    return slice(first, first + len(layout.rx) * RxWord.SIZE, RxWord.SIZE)


def _plan_values(old: Image, new: Image) -> tuple[CopyPlan, CopyPlan]:
    """Return the copies of variables that the engine writes, and of those that others write."""
    engine: list[Move] = []
    others: list[Move] = []
    for name, slot in new.slots.items():
        was = old.slots.get(name)
        if was is None:
            continue
        moves = engine if was.writer is Writer.ENGINE else others
        # Compared as parsed types: the same type can be written in more than one way.
        parts = shared_parts(datatypes.parse(was.type), datatypes.parse(slot.type))
        moves += [Move(was.bit_offset + a, slot.bit_offset + b, bits) for a, b, bits in parts]
    before = {slot.name: slot for slot in old.layout.rx}
    for pd in new.layout.rx:
        if pd.name in before:  # its header holds the quality
            move = Move(8 * before[pd.name].offset, 8 * pd.offset, 8 * PdHeader.SIZE)
            engine.append(move)
    return CopyPlan(engine), CopyPlan(others)


def _joined(runs: Iterable[_WordRun]) -> list[_WordRun]:
    """Join runs that are adjacent on both sides."""
    joined: list[_WordRun] = []
    for run in runs:
        if joined:
            last = joined[-1]
            if (last.source + last.size, last.target + last.size) == run[:2]:
                joined[-1] = last._replace(size=last.size + run.size)
                continue
        joined.append(run)
    return joined


def _copy(runs: Iterable[_WordRun], old: memoryview, new: memoryview) -> None:
    for source, target, size in runs:
        new[target : target + size] = old[source : source + size]


class PortChanges(NamedTuple):
    """Differences between the EAP ports of two specifications.

    A port whose settings change is in both, the old one and the new one.
    """

    gone: tuple[PortSpec, ...]
    added: tuple[PortSpec, ...]

    def __bool__(self) -> bool:
        """Return whether any port changes."""
        return bool(self.gone or self.added)


def port_changes(
    old: StationSpec, new: StationSpec, ignored: Collection[str] = _OF_ENGINE
) -> PortChanges:
    """Return the EAP ports that go and come from *old* to *new*.

    Other values of *ignored* fields leave a port what it is, by default of those that its channels
    in the engine do not depend on.
    """
    before = {port.name: port for port in old.ports if port.kind is PortKind.EAP}
    after = {port.name: port for port in new.ports if port.kind is PortKind.EAP}
    changed = {
        name
        for name in before.keys() & after.keys()
        if any(True for _ in _port_differences(before[name], after[name], ignored))
    }
    return PortChanges(
        tuple(port for name, port in before.items() if name not in after or name in changed),
        tuple(port for name, port in after.items() if name not in before or name in changed),
    )


def describe_port_changes(old: StationSpec, new: StationSpec) -> Iterator[str]:
    """Yield the changes of EAP ports from *old* to *new*, one line each."""
    gone, added = port_changes(old, new, PORT_CONTENT)
    before = {port.name: port for port in gone}
    names = {port.name for port in added}
    yield from (f"port {port.name}: removed" for port in gone if port.name not in names)
    for port in added:
        if port.name in before:
            for what in _port_differences(before[port.name], port, PORT_CONTENT):
                yield f"port {port.name}: {what}"
        else:
            yield f"port {port.name}: added at {port.interface}"


def needs_new_start(old: StationSpec, new: StationSpec) -> list[str]:
    """Return the differences that the engine cannot apply while it runs, one line each."""
    if old.name == new.name:
        return []
    return [f"station {old.name} cannot become {new.name}: restart the appliance"]


def _port_differences(old: PortSpec, new: PortSpec, ignored: Collection[str]) -> Iterator[str]:
    was = asdict(old)
    for field, value in asdict(new).items():
        if field not in ignored and value != was[field]:
            yield f"{field} {was[field]} -> {value}"


def restarting_buses(old: StationSpec, new: StationSpec) -> set[str]:
    """Return the bus ports whose slaves go to INIT and are brought up with other settings."""
    # The path of the file alone changes nothing at the slaves.
    before, after = (
        {
            port.name: (port.interface, replace(port.bus, file=""))
            for port in spec.ports
            if port.bus is not None
        }
        for spec in (old, new)
    )
    is_other_cycle = old.cycle_us != new.cycle_us
    return {
        name
        for name, (interface, bus) in after.items()
        if name in before
        and (before[name] != (interface, bus) or (is_other_cycle and bus.has_sync))
    }
