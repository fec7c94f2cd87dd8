"""One TxFrame: triggers of its PDs, prebuilt buffers patched in place, and the selection per cycle.

The headers of a frame never change as long as the same PDs are in it, so a buffer is kept for each
selection of PDs that was sent; a cycle only writes the counter and the data.  The copies that put a
PD's data together from its variables are planned once.

docs/triggers.md holds the truth table of the triggers, which this module follows:
Rule 1: a frame's divider is a gate; nothing of the frame is sent while it is closed.  Events and
changes of that time wait for it; cycle time and divider only count in cycles of an open gate.
Rule 2: when several reasons hold at once the PD is sent once, for the first of: event, cycle or
divider, change, change time-out.
Rule 3: suppression beats every reason; a PD that was due counts as skipped, an event is cleared.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

from eap.codec import datatypes
from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import CYCLE_OFFSET, FIRST_PD, PD_FRAME_START, PdFrameHeader, PdHeader
from eap.ids import NetId
from eap.pd.authentication import SIGNATURE_ID, SIGNATURE_SIZE, SIGNATURE_VERSION
from eap.pd.compiledplan import compile_patch
from eap.pd.image import Image, Inputs
from eap.pd.layout import FrameSlot, TxSlot
from eap.pd.link import FrameChannel, OutFrame
from eap.pd.quality import ForwardedQuality
from eap.pd.spec import TriggerSpec, Writer
from eap.pd.words import REASON_INDEX, Reason

SUPPRESS_BIT = 1
EVENT_BIT = 2

_CYCLE = REASON_INDEX[Reason.CYCLE]
_DIVIDER = REASON_INDEX[Reason.DIVIDER]
_CHANGE = REASON_INDEX[Reason.CHANGE]
_CHANGE_TIMEOUT = REASON_INDEX[Reason.CHANGE_TIMEOUT]
_EVENT = REASON_INDEX[Reason.EVENT]


class Schedule(NamedTuple):
    """Due in each cycle whose counter leaves *phase* when divided by *step*."""

    step: int
    phase: int
    reason: int
    """Index into REASONS."""

    def is_due(self, cycle: int) -> bool:
        """Return whether *cycle* is one of them."""
        return cycle % self.step == self.phase


def plan_schedule(trigger: TriggerSpec, cycle_us: int, gate: tuple[int, int]) -> Schedule | None:
    """Return the fixed schedule of a PD, None when only changes or events send it.

    Args:
        trigger: The PD's triggers.
        cycle_us: The device cycle.
        gate: Divider and modulo of its frame; divider 0 is no gate.
    """
    if trigger.cycle_us:
        # Exact: rules.check_times() requires a multiple of the device cycle.
        return Schedule(trigger.cycle_us // cycle_us, 0, _CYCLE)
    if trigger.divider:
        return Schedule(trigger.divider, trigger.modulo, _DIVIDER)
    if trigger.on_change is not None or trigger.event:
        return None
    if gate[0]:
        return Schedule(gate[0], gate[1], _DIVIDER)
    return Schedule(1, 0, _CYCLE)


class Trigger:
    """The triggers of one PD at run time."""

    __slots__ = (
        "_event",
        "_inhibit_ns",
        "_on_change",
        "_sent_at_ns",
        "_sent_data",
        "_sent_for_change_ns",
        "_timeout_ns",
        "accepts_events",
        "schedule",
        "suppressed",
    )

    def __init__(self, spec: TriggerSpec, schedule: Schedule | None) -> None:
        self.schedule = schedule
        self.suppressed = False
        self.accepts_events = spec.event
        self._event = False
        self._on_change = spec.on_change is not None
        self._timeout_ns = spec.on_change.timeout_ms * 1_000_000 if spec.on_change else 0
        self._inhibit_ns = spec.on_change.inhibit_us * 1_000 if spec.on_change else 0
        self._sent_data: bytes | None = None
        self._sent_at_ns = 0
        self._sent_for_change_ns: int | None = None

    @property
    def wants_data(self) -> bool:
        """True if :meth:`reason` has to see the data."""
        return self._on_change

    def raise_event(self) -> None:
        """Ask for the PD to be sent at the next opportunity."""
        self._event = True

    def reason(self, cycle: int, now_ns: int, data: bytes | None) -> int | None:
        """Return the index of the reason to send now, None if there is none.

        Args:
            cycle: The station's cycle counter; the frame's gate is open in it.
            now_ns: The current time.
            data: What would be sent; only looked at by an on-change trigger.
        """
        if self._event:
            return _EVENT
        if self.schedule is not None and self.schedule.is_due(cycle):
            return self.schedule.reason
        if not self._on_change:
            return None
        # None after a start: the first data is a change, since no subscriber has it yet.
        if data != self._sent_data:
            last_ns = self._sent_for_change_ns
            if last_ns is None or now_ns - last_ns >= self._inhibit_ns:
                return _CHANGE
        elif self._timeout_ns and now_ns - self._sent_at_ns >= self._timeout_ns:
            return _CHANGE_TIMEOUT
        return None

    def clear_event(self) -> None:
        """Forget a raised event: the PD was sent, or skipped while suppressed."""
        self._event = False

    def sent(self, reason: int, now_ns: int, data: bytes | None) -> None:
        """Note that the PD went out for *reason*."""
        self._event = False
        self._sent_at_ns = now_ns
        self._sent_data = data
        # Only changes count for the inhibit time; an event or a time-out does not delay the next
        # change.
        if reason == _CHANGE:
            self._sent_for_change_ns = now_ns

    def forget(self) -> None:
        """Reset to the state at a start: no event is pending, and the next data is a change."""
        self._event = False
        self._sent_data = None

    def follow(self, before: Trigger, *, is_same: bool) -> None:
        """Continue the state of *before*; *is_same* means that the PD is sent unchanged.

        If it is not, no subscriber has its data yet, and an on-change trigger sends it.
        """
        self._event = before._event and self.accepts_events
        self._sent_at_ns = before._sent_at_ns
        self._sent_for_change_ns = before._sent_for_change_ns
        self._sent_data = before._sent_data if is_same else None


Run: TypeAlias = tuple[memoryview, int, int, int]
"""Memory, source offset, offset in the PD, size; all three in bytes, or all three in bits."""


class Gather:
    """Copies the variables of one PDO into a buffer.

    Args:
        image: Where the engine's own variables are read.
        inputs: Where all others are read.
        variables: Names, in PDO order.
    """

    def __init__(self, image: Image, inputs: Inputs, variables: Sequence[str]) -> None:
        slots = [image.slots[name] for name in variables]
        kinds = [datatypes.parse(slot.type) for slot in slots]
        plan = datatypes.layout(kinds)
        self.size = plan.size
        runs: list[Run] = []
        self.bits: list[Run] = []
        self.image, self.inputs = image, inputs
        for slot, kind, target in zip(slots, kinds, plan.bit_offsets, strict=True):
            memory = image.memory if slot.writer is Writer.ENGINE else inputs.memory
            if kind.is_bits:
                self.bits.append((memory, slot.bit_offset, target, kind.bit_length))
                continue
            run = (memory, slot.bit_offset // 8, target // 8, kind.size)
            if runs and _continues(runs[-1], run):
                _, source, first, size = runs.pop()
                run = (memory, source, first, size + kind.size)
            runs.append(run)
        self.runs = runs

    @property
    def has_bits(self) -> bool:
        """True if :meth:`bits_into` has anything to do."""
        return bool(self.bits)

    def copies(self, offset: int) -> list[tuple[slice, memoryview]]:
        """Return the copies of whole bytes, by target slice, of a PD that starts at *offset*."""
        return [
            (slice(offset + target, offset + target + size), memory[source : source + size])
            for memory, source, target, size in self.runs
        ]

    def into(self, buffer: memoryview, offset: int) -> None:
        """Write the PD's data as it is now to *buffer* at *offset*."""
        for where, data in self.copies(offset):
            buffer[where] = data
        self.bits_into(buffer, offset)

    def bits_into(self, buffer: memoryview, offset: int) -> None:
        """Write the bits among the variables, packed."""
        # Put together first: several bit fields share a byte, which then is written once.
        octets: dict[int, int] = {}
        for memory, source, target, length in self.bits:
            start, shift = divmod(source, 8)
            value = int.from_bytes(memory[start : start + 2], "little") >> shift
            first, shift = divmod(target, 8)
            value = (value & (1 << length) - 1) << shift
            octets[first] = octets.get(first, 0) | value & 0xFF
            if shift + length > 8:  # also when its upper bits are zero now
                octets[first + 1] = octets.get(first + 1, 0) | value >> 8
        for octet, value in octets.items():
            buffer[offset + octet] = value


def _continues(run: Run, following: Run) -> bool:
    memory, source, target, size = run
    return (memory is following[0]) and (source + size, target + size) == following[1:3]


_SELECTIONS_KEPT = 64
NO_ADDRESS = "00:00:00:00:00:00"
"""In the buffers of a frame that waits for an address: those are never sent."""
_put_u16 = struct.Struct("<H").pack_into


class TxPd:
    """One TxPD at run time."""

    __slots__ = ("data", "gather", "quality", "reason", "slot", "trigger")

    def __init__(
        self,
        slot: TxSlot,
        trigger: Trigger,
        gather: Gather,
        quality: ForwardedQuality | None = None,
    ) -> None:
        self.slot = slot
        self.trigger = trigger
        self.gather = gather
        self.quality = quality
        """Quality of received values among the variables; None if there are none."""
        self.data: bytes | None = None
        """Data that this cycle would send, if the trigger needs it."""
        self.reason = 0

    def is_due(self, cycle: int, now_ns: int) -> bool:
        """Decide whether to send in this cycle, and note the reason."""
        if self.trigger.wants_data:
            scratch = bytearray(self.gather.size)
            self.gather.into(memoryview(scratch), 0)
            self.data = bytes(scratch)
        reason = self.trigger.reason(cycle, now_ns, self.data)
        if reason is None:
            return False
        self.reason = reason
        return True


class Selection:
    """A buffer for some of a frame's PDs.

    Attributes:
        patch: Writes the counter of a cycle and the current data of all PDs.
    """

    __slots__ = ("out", "patch", "pds")

    def __init__(self, out: OutFrame, pds: tuple[TxPd, ...]) -> None:
        self.out = out
        self.pds = pds
        placed = list(zip(pds, _data_offsets(pds, out.headroom), strict=True))
        self.patch: Callable[[int], None] = compile_patch(out, placed) or _patch(out, placed)


def _patch(out: OutFrame, placed: Iterable[tuple[TxPd, int]]) -> Callable[[int], None]:
    """Return the function that patches *out*, whose PDs have their data at the given offsets."""
    view, cycle_offset = out.view, out.headroom + CYCLE_OFFSET
    # One flat list of all PDs' copies: a call for each PD would take longer than the copies.
    copies = [copy for pd, offset in placed for copy in pd.gather.copies(offset)]
    others = [(pd.gather.bits_into, at) for pd, at in placed if pd.gather.has_bits]
    others += [(pd.quality.into, at) for pd, at in placed if pd.quality is not None]

    def patch(cycle: int) -> None:
        _put_u16(view, cycle_offset, cycle & 0xFFFF)
        for where, data in copies:
            view[where] = data
        for write_into, offset in others:
            write_into(view, offset)

    return patch


class TxFrame:
    """One TxFrame at run time."""

    def __init__(
        self,
        slot: FrameSlot,
        publisher: NetId,
        pds: tuple[TxPd, ...],
        gate: tuple[int, int],
        channel: FrameChannel,
        destination: str,
        *,
        is_signed: bool = False,
    ) -> None:
        self.slot = slot
        self.destination = destination
        """Current destination; empty while that is not known, and then the frame is not sent."""
        self.pds = pds
        self.gate = gate
        self.suppressed = False
        self._publisher = publisher
        self._channel = channel
        self._is_signed = is_signed
        self._selections: dict[tuple[TxPd, ...], Selection] = {}
        self.whole = self._select(pds)
        self.schedule = _common_schedule(pds)
        """Common schedule of all PDs, None if each cycle has to select them."""

    @property
    def is_plain(self) -> bool:
        """True if the frame goes whole by its schedule and nothing holds it back.

        Anything that decides for each cycle makes it false: :meth:`select` is never called for
        plain frames.  Where its value changes, ``Publisher._group_frames`` has to run between two
        cycles.
        """
        return (
            self.schedule is not None
            and not self.is_held
            and not any(pd.trigger.suppressed for pd in self.pds)
        )

    @property
    def is_held(self) -> bool:
        """True if it does not go at all: suppressed, or without a known address."""
        return self.suppressed or not self.destination

    def retarget(self, destination: str) -> None:
        """Send to *destination* from now on; the buffers are rebuilt."""
        self.destination = destination
        self._selections.clear()
        self.whole = self._select(self.pds)

    def select(self, cycle: int, now_ns: int) -> tuple[Selection | None, list[TxPd]]:
        """Return the selection to send in this cycle, if any, and PDs due but held back."""
        divider, modulo = self.gate
        # Before the triggers are asked: events and changes wait for the gate and are not skipped
        # (rule 1).
        if divider and cycle % divider != modulo:
            return None, []
        due = [pd for pd in self.pds if pd.is_due(cycle, now_ns)]
        if self.is_held:
            return None, due
        skipped = [pd for pd in due if pd.trigger.suppressed]
        chosen = tuple(pd for pd in due if not pd.trigger.suppressed)
        return (self._select(chosen) if chosen else None), skipped

    def _select(self, pds: tuple[TxPd, ...]) -> Selection:
        if (selection := self._selections.get(pds)) is None:
            # Bounded: n PDs that are sent on change have 2**n selections.
            if len(self._selections) >= _SELECTIONS_KEPT:
                self._selections.clear()
            selection = self._selections[pds] = Selection(self._build(pds), pds)
        return selection

    def _build(self, pds: tuple[TxPd, ...]) -> OutFrame:
        destination = self.destination or NO_ADDRESS
        return build_frame(
            self._publisher, pds, self._channel, destination, is_signed=self._is_signed
        )


def build_frame(
    publisher: NetId,
    pds: tuple[TxPd, ...],
    channel: FrameChannel,
    destination: str,
    *,
    is_signed: bool = False,
) -> OutFrame:
    """Return a frame with all headers and no data yet; a signed one ends with a signature."""
    header = channel.link_header(destination)
    # The cycle counter is 0 here; patch() writes it in each cycle, at CYCLE_OFFSET.
    body = PdFrameHeader(publisher, len(pds) + is_signed, 0).encode()
    for pd in pds:
        body += PdHeader(pd.slot.pd_id, pd.slot.version, pd.slot.size).encode()
        body += bytes(pd.slot.size)
    signature = 0
    if is_signed:
        body += PdHeader(SIGNATURE_ID, SIGNATURE_VERSION, SIGNATURE_SIZE).encode()
        signature = PD_FRAME_START + len(body)
        body += bytes(SIGNATURE_SIZE)
    # Length does not count the padding behind it, by which receivers tell the two apart.
    octets = header + EtherCatHeader(len(body)).encode() + body
    buffer = bytearray(octets.ljust(channel.minimum_size, b"\0"))
    return OutFrame(buffer, len(header), destination, signature)


def _data_offsets(pds: tuple[TxPd, ...], headroom: int) -> Iterator[int]:
    offset = headroom + FIRST_PD
    for pd in pds:
        offset += PdHeader.SIZE
        yield offset
        offset += pd.slot.size


def _common_schedule(pds: tuple[TxPd, ...]) -> Schedule | None:
    schedules = {pd.trigger.schedule if pd.slot.by_schedule else None for pd in pds}
    # Common only without change and event triggers: then the cycle counter alone decides.
    return schedules.pop() if len(schedules) == 1 else None
