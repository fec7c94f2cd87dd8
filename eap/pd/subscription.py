"""RxPDs at run time: expected header, substitute, and the plan that checks and copies a frame.

Publishers repeat the layout of their frames.  The plan of a layout compares all PD headers in one
step and copies PDs that lie side by side, both in the frame and in the image, in one piece.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from eap.codec import datatypes
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.pd import FIRST_PD, PD_FRAME_START, PdFrameHeader, PdHeader, follow_pds
from eap.errors import CodecError, TruncatedError
from eap.ids import NetId
from eap.pd.address import SourceWatch, source_octets
from eap.pd.authentication import SignatureCheck
from eap.pd.compiledplan import compile_plan
from eap.pd.copyplan import CopyPlan
from eap.pd.image import Image, default_value, put
from eap.pd.layout import RxSlot
from eap.pd.link import TOGGLE_BIT
from eap.pd.poll import OutgoingPoll, PollAnswer
from eap.pd.sequence import SequenceTracker
from eap.pd.spec import RxPdSpec, Substitute
from eap.pd.words import PdDropReason


class RxSubscription:
    """One RxPD at run time.

    Args:
        spec: The expected PD.
        slot: Its place in the image.
        substitute: What its variables hold after the time-out.
        poll: The poll that requests it; None if it is pushed.

    Attributes:
        tracker: Tracker of its arrivals; the subscriber opens it.
        alternates: Copy plans of other accepted layouts, by version and length.
        answer: Its role as an answer to *poll*; None if it is pushed.
        source: The address that its frames must come from; empty for any.
        auth: What is made of the signature of its frames.
    """

    __slots__ = (
        "alternates",
        "answer",
        "auth",
        "ignore_version",
        "slot",
        "source",
        "substitute",
        "timeout_ns",
        "tracker",
    )

    def __init__(
        self,
        spec: RxPdSpec,
        slot: RxSlot,
        substitute: SubstituteValue,
        poll: OutgoingPoll | None = None,
    ) -> None:
        self.slot = slot
        self.answer = None if poll is None else PollAnswer(spec.name, poll, slot.words)
        self.alternates = {(each.version, each.size): each.copy_plan() for each in slot.alternates}
        self.ignore_version = spec.ignore_version
        self.timeout_ns = spec.timeout_ms * 1_000_000
        self.substitute = substitute
        self.source = source_octets(spec.source) if spec.source else b""
        self.auth = spec.auth
        self.tracker: SequenceTracker

    def mismatch(self, version: int, length: int, source: bytes) -> PdDropReason | None:
        """Return the reason to drop such a PD from the address *source*, None to accept it."""
        if self.source and source != self.source:
            return PdDropReason.WRONG_SOURCE
        # Before the version is compared: an alternate may have another one.
        if (version, length) in self.alternates:
            return None
        # VarState tells the two apart (bit 0 version, bit 1 length); the version is named first.
        if version != self.slot.version and not self.ignore_version:
            return PdDropReason.VERSION
        if length != self.slot.size:
            return PdDropReason.LENGTH
        return None

    def deadline_ns(self) -> int | None:
        """Return when its data is too old, None as long as it was not requested again."""
        since_ns: int | None = self.tracker.arrived_at_ns
        # The time-out of polled data runs from the request: without one nothing can be late.
        if self.answer is not None:
            since_ns = self.answer.poll.requested_since(self.answer.name)
        return None if since_ns is None else since_ns + self.timeout_ns


class SubstituteValue:
    """The bytes that replace a PD's data after its time-out; with HOLD there are none."""

    def __init__(self, image: Image, slot: RxSlot) -> None:
        start = slot.offset + PdHeader.SIZE
        self._memory = image.memory
        self._data = slice(start, start + slot.size)
        self._octets = _octets(image, slot)

    def apply(self) -> None:
        """Overwrite the data with the substitute."""
        if self._octets is not None:
            self._memory[self._data] = self._octets


def _octets(image: Image, slot: RxSlot) -> bytes | None:
    if slot.substitute is Substitute.HOLD:
        return None
    if slot.substitute is Substitute.ZERO:
        return bytes(slot.size)
    octets = memoryview(bytearray(slot.size))
    start = 8 * (slot.offset + PdHeader.SIZE)
    for name in slot.variables:
        variable = image.slots[name]
        kind = datatypes.parse(variable.type)
        value = kind.encode(default_value(variable))
        put(octets, variable.bit_offset - start, kind.bit_length, value)
    return bytes(octets)


Copy: TypeAlias = tuple[slice, slice]
"""Bytes of the frame and where they go in the image."""


class AcceptedPd(NamedTuple):
    """A PD of the frame that a subscription accepts: offsets of its header in frame and image."""

    tracker: SequenceTracker
    words: int
    """Index of the first word of the RxPD."""
    source: int
    target: int
    size: int
    """Bytes, header included."""
    alternate: CopyPlan | None = None
    """Plan that copies it, header included, if its layout differs from the image's."""


class DroppedPd(NamedTuple):
    """A PD that no subscription accepts: counters to add one to, and VarState words to set."""

    counters: tuple[int, ...]
    mismatches: tuple[tuple[int, int], ...] = ()
    """(first word of the RxPD, VarState)"""
    wrong_source: tuple[int, ...] = ()
    """First words of the RxPDs whose publisher has another address."""


class FrameHead(NamedTuple):
    """Fields of a frame's headers that its layout does not follow from."""

    publisher: bytes
    length: int
    """Of the EtherCAT header."""
    eap_sm: int = 0


Signature: TypeAlias = "tuple[SignatureCheck, Mapping[PdDropReason, FramePlan]]"
"""Check of the signature of a frame, with the plans of the frames that it refuses."""


class FramePlan:
    """The plan of one layout.

    Attributes:
        headers: Reads all PD headers but their quality from a frame, at offset FIRST_PD.
        expected: Result of *headers* for which this plan applies.
        end: Bytes of the frame by its Length; where that is wrong, by its PDs.
        head: Fields of its headers.
        is_single: Whether there is one PD in it.
        parts: For each tracker that the frame concerns, the copies to make if it agrees.
        accepted_words: First words of the RxPDs that take one of its PDs.
        has_more: Whether there is anything of the next four, or an EAP SM byte.
        alternates: PDs that are laid out otherwise: tracker, offset in the frame, copy to make.
        refused: The PDs that no subscription accepts.
        requests: RxPDs that request PDs of this station, with their trackers.
        answers: RxPDs that this station polled, likewise.
        any_publisher: Trackers that follow any publisher.
        signature: Check of the frame's signature, with the plans of frames that it refuses, by
            reason; None if no subscription wants it.
        has_checks: Whether there is anything of the last two.
        fast: The same for the compiled part; None if it leaves such frames to Python.
        publisher: The frame's, as a number.
        watch: The addresses that such frames come from; it belongs to this plan if they do.
    """

    __slots__ = (
        "accepted_words",
        "alternates",
        "answers",
        "any_publisher",
        "end",
        "expected",
        "fast",
        "has_checks",
        "has_more",
        "head",
        "headers",
        "is_single",
        "parts",
        "publisher",
        "refused",
        "requests",
        "signature",
        "watch",
    )

    def __init__(
        self,
        head: FrameHead,
        end: int,
        pds: Iterable[tuple[bytes, int]],
        taken: Iterable[AcceptedPd],
        refused: Iterable[DroppedPd],
        *,
        watch: SourceWatch,
        requests: Iterable[tuple[SequenceTracker, str]] = (),
        answers: Iterable[tuple[SequenceTracker, PollAnswer]] = (),
        any_publisher: Iterable[SequenceTracker] = (),
        signature: Signature | None = None,
    ) -> None:
        """Build the plan from (header without quality, data length) of each PD and their fate."""
        pds = tuple(pds)
        # The quality is skipped with the data: it is the one header field that changes between
        # frames.
        layout = struct.Struct("<" + "".join(f"6s{2 + length}x" for _, length in pds))
        self.headers: Callable[..., tuple[Any, ...]] = layout.unpack_from
        self.expected: tuple[Any, ...] = tuple(header for header, _ in pds)
        self.end = end
        self.is_single = len(pds) == 1
        taken = tuple(taken)
        self.parts = _parts(taken)
        self.alternates = tuple(
            (pd.tracker, pd.source, pd.alternate) for pd in taken if pd.alternate is not None
        )
        self.accepted_words = tuple(pd.words for pd in taken)
        self.refused = tuple(refused)
        self.requests = tuple(requests)
        self.answers = tuple(answers)
        self.head = head
        more = (self.alternates, self.refused, self.requests, self.answers, head.eap_sm)
        self.has_more = any(more)
        self.any_publisher = tuple(any_publisher)
        self.signature = signature
        self.has_checks = bool(self.any_publisher) or signature is not None
        self.publisher = int.from_bytes(head.publisher)
        self.watch = watch
        self.fast = compile_plan(self)

    @property
    def is_usual(self) -> bool:
        """True if a frame of this layout changes nothing but trackers, data and counters."""
        more = (self.has_checks, self.alternates, self.requests, self.answers, self.head.eap_sm)
        return not any(more) and not any(pd.mismatches or pd.wrong_source for pd in self.refused)

    @property
    def alternatives(self) -> int:
        """Number of plans that belong to the layout."""
        return 1 if self.signature is None else 1 + len(self.signature[1])

    @property
    def has_wrong_length(self) -> bool:
        """True if the Length of the EtherCAT header does not cover the PDs, or too much."""
        return self.end != PD_FRAME_START + self.head.length

    def admit(self, data: memoryview) -> FramePlan:
        """Return the plan for a frame by its signature: this one, or that of what is wrong.

        Trackers that follow any publisher follow that of the frame.
        """
        plan = self
        if self.signature is not None:
            check, refusing = self.signature
            if (fault := check.fault(data)) is not None:
                plan = refusing[fault]
        for tracker in plan.any_publisher:
            tracker.follow(plan.publisher)
        return plan

    def enter_toggle(self, cycle: int) -> None:
        """Note the toggle bit of a frame of *cycle*; senders that leave EAP SM 0 have none."""
        if self.head.eap_sm:
            for tracker, _ in self.parts:
                tracker.enter_toggle(self.head.eap_sm & TOGGLE_BIT, cycle)

    def copy_alternates(self, data: memoryview, cycle: int, memory: memoryview) -> None:
        """Copy PDs with another layout from the frame *data* of *cycle*, if they were accepted."""
        for tracker, source, alternate in self.alternates:
            if tracker.has_taken(cycle):
                alternate.run(data[source:], memory)

    def example(self) -> memoryview:
        """Return a frame of this layout, without data."""
        publisher, length, eap_sm = self.head
        frame = bytearray(EtherCatHeader(length).encode())
        count = len(self.expected)
        frame += PdFrameHeader(NetId(publisher), count, 0, eap_sm=eap_sm).encode()
        for header in self.expected:
            frame += header + bytes(2)
            frame += bytes(PdHeader.decode(header + bytes(2)).length)
        return memoryview(frame.ljust(self.end, b"\0"))


def _parts(taken: Iterable[AcceptedPd]) -> tuple[tuple[SequenceTracker, tuple[Copy, ...]], ...]:
    runs: dict[SequenceTracker, list[AcceptedPd]] = {}
    for pd in taken:
        pieces = runs.setdefault(pd.tracker, [])
        if pd.alternate is not None:
            continue
        if pieces and _continues(pieces[-1], pd):
            pieces[-1] = pieces[-1]._replace(size=pieces[-1].size + pd.size)
        else:
            pieces.append(pd)
    return tuple(
        (
            tracker,
            tuple(
                (slice(p.source, p.source + p.size), slice(p.target, p.target + p.size))
                for p in pieces
            ),
        )
        for tracker, pieces in runs.items()
    )


def _continues(run: AcceptedPd, pd: AcceptedPd) -> bool:
    return run.source + run.size == pd.source and run.target + run.size == pd.target


HEADER_KEY = struct.Struct("<6s2x")
"""A PD header as plans compare it: everything but the quality."""
assert HEADER_KEY.size == PdHeader.SIZE  # noqa: S101  the two must not drift apart


def walk(data: memoryview, size: int) -> list[tuple[PdHeader, int]] | PdDropReason:
    """Return each PD header with its offset, or the reason the frame is dropped as a whole."""
    try:
        ethercat = EtherCatHeader.decode(data[:size])
        if ethercat.type != FrameType.PROCESS_DATA:
            return PdDropReason.WRONG_TYPE
        end = PD_FRAME_START + ethercat.length
        frame = data[: min(end, size)]
        count = PdFrameHeader.decode(frame, PD_FRAME_START).count
        # Not left to the loop, which would report a truncated frame instead of a wrong count.
        if FIRST_PD + count * PdHeader.SIZE > end:
            return PdDropReason.COUNT_TOO_LARGE
        pds = []
        offset = FIRST_PD
        for _ in range(count):
            header = PdHeader.decode(frame, offset)
            pds.append((header, offset))
            offset += PdHeader.SIZE + header.length
    except TruncatedError:
        return PdDropReason.TRUNCATED
    # Bytes behind the last PD and behind Length are ignored: padding, and what later versions add.
    return pds if offset <= end <= size else PdDropReason.TRUNCATED


def walk_by_pds(data: memoryview, size: int) -> list[tuple[PdHeader, int]]:
    """Return what :func:`walk` returns for a frame whose Length is wrong; nothing if PDs are cut.

    Some senders write a Length that has nothing to do with the frame (4 always).
    """
    try:
        frame = follow_pds(data[:size])
    except CodecError:
        return []
    pds = []
    offset = FIRST_PD
    for header, _ in frame.pds:
        pds.append((header, offset))
        offset += PdHeader.SIZE + header.length
    return [] if frame.is_cut else pds
