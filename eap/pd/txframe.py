"""One TxFrame: prebuilt buffers, patched in place, and the decision which of its PDs go.

The headers of a frame never change as long as the same PDs are in it, so a buffer is kept for each
selection of PDs that was sent; a cycle only writes the counter and the data.  The copies that put a
PD's data together from its variables are planned once.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import TypeAlias

from eap.codec import datatypes
from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import CYCLE_OFFSET, FIRST_PD, PdFrameHeader, PdHeader
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.layout import FrameSlot, TxSlot
from eap.pd.link import FrameChannel, OutFrame
from eap.pd.spec import Writer
from eap.pd.trigger import Schedule, Trigger

Run: TypeAlias = tuple[memoryview, int, int, int]
"""Memory, where from, where to in the PD, how much; all three in octets, or all three in bits."""


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
        self._bits: list[Run] = []
        for slot, kind, target in zip(slots, kinds, plan.bit_offsets, strict=True):
            memory = image.memory if slot.writer is Writer.ENGINE else inputs.memory
            if kind.is_bits:
                self._bits.append((memory, slot.bit_offset, target, kind.bit_length))
                continue
            run = (memory, slot.bit_offset // 8, target // 8, kind.size)
            if runs and _continues(runs[-1], run):
                _, source, first, size = runs.pop()
                run = (memory, source, first, size + kind.size)
            runs.append(run)
        self._runs = [
            (target, target + size, memory[source : source + size])
            for memory, source, target, size in runs
        ]

    @property
    def has_bits(self) -> bool:
        """True if :meth:`bits_into` has anything to do."""
        return bool(self._bits)

    def copies(self, offset: int) -> list[tuple[slice, memoryview]]:
        """Return what to copy to where for the whole octets of a PD that starts at *offset*."""
        return [(slice(offset + first, offset + last), data) for first, last, data in self._runs]

    def into(self, buffer: memoryview, offset: int) -> None:
        """Write the PD's data as it is now to *buffer* at *offset*."""
        for where, data in self.copies(offset):
            buffer[where] = data
        self.bits_into(buffer, offset)

    def bits_into(self, buffer: memoryview, offset: int) -> None:
        """Write the bits among the variables, packed."""
        octets: dict[int, int] = {}
        for memory, source, target, length in self._bits:
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
NOWHERE = "00:00:00:00:00:00"
"""In the buffers of a frame that waits for an address: those are never sent."""
_put_u16 = struct.Struct("<H").pack_into


class TxPd:
    """One TxPD at run time."""

    __slots__ = ("data", "gather", "reason", "slot", "trigger")

    def __init__(self, slot: TxSlot, trigger: Trigger, gather: Gather) -> None:
        self.slot = slot
        self.trigger = trigger
        self.gather = gather
        self.data: bytes | None = None
        """What this cycle would send, where the trigger has to see it."""
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
    """A buffer for some of a frame's PDs, and where their data goes in it."""

    __slots__ = ("_bits", "_copies", "_cycle_offset", "out", "pds")

    def __init__(self, out: OutFrame, pds: tuple[TxPd, ...]) -> None:
        self.out = out
        self.pds = pds
        self._cycle_offset = out.headroom + CYCLE_OFFSET
        placed = list(zip(pds, _data_offsets(pds, out.headroom), strict=True))
        # One flat list of all PDs' copies: a call for each PD would take longer than the copies.
        self._copies = [copy for pd, offset in placed for copy in pd.gather.copies(offset)]
        self._bits = [(pd.gather.bits_into, at) for pd, at in placed if pd.gather.has_bits]

    def patch(self, cycle: int) -> None:
        """Write the counter and the current data of all PDs."""
        view = self.out.view
        _put_u16(view, self._cycle_offset, cycle & 0xFFFF)
        for where, data in self._copies:
            view[where] = data
        for bits_into, offset in self._bits:
            bits_into(view, offset)


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
    ) -> None:
        self.slot = slot
        self.destination = destination
        """Where it goes now; empty while that is not known, and then it does not go."""
        self.pds = pds
        self.gate = gate
        self.suppressed = False
        self._publisher = publisher
        self._channel = channel
        self._selections: dict[tuple[TxPd, ...], Selection] = {}
        self.whole = self._select(pds)
        self.schedule = _common_schedule(pds)
        """When all PDs go together by the clock, None when each cycle has to find out."""

    @property
    def is_plain(self) -> bool:
        """True if the frame goes whole by its schedule and nothing holds it back."""
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
        """Send to *destination* from now on; the buffers are built anew."""
        self.destination = destination
        self._selections.clear()
        self.whole = self._select(self.pds)

    def select(self, cycle: int, now_ns: int) -> tuple[Selection | None, list[TxPd]]:
        """Return what to send in this cycle, if anything, and what was due but held back."""
        divider, modulo = self.gate
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
            if len(self._selections) >= _SELECTIONS_KEPT:
                self._selections.clear()
            selection = self._selections[pds] = Selection(self._build(pds), pds)
        return selection

    def _build(self, pds: tuple[TxPd, ...]) -> OutFrame:
        return build_frame(self._publisher, pds, self._channel, self.destination or NOWHERE)


def build_frame(
    publisher: NetId, pds: tuple[TxPd, ...], channel: FrameChannel, destination: str
) -> OutFrame:
    """Return a frame with all headers and no data yet."""
    header = channel.link_header(destination)
    body = PdFrameHeader(publisher, len(pds), 0).encode()
    for pd in pds:
        body += PdHeader(pd.slot.pd_id, pd.slot.version, pd.slot.size).encode()
        body += bytes(pd.slot.size)
    octets = header + EtherCatHeader(len(body)).encode() + body
    buffer = bytearray(octets.ljust(channel.minimum_size, b"\0"))
    return OutFrame(buffer, len(header), destination)


def _data_offsets(pds: tuple[TxPd, ...], headroom: int) -> Iterator[int]:
    offset = headroom + FIRST_PD
    for pd in pds:
        offset += PdHeader.SIZE
        yield offset
        offset += pd.slot.size


def _common_schedule(pds: tuple[TxPd, ...]) -> Schedule | None:
    schedules = {pd.trigger.schedule if pd.slot.by_schedule else None for pd in pds}
    return schedules.pop() if len(schedules) == 1 else None
