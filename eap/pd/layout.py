"""Layout of a station's process image: offsets of words, variables, PDs and slaves.

The image is a header, the words of ``words.py``, one region of variables for each writer, and the
directory: this layout as JSON, so that a program that attaches needs no plant file.

A received PD lies in the engine's region as it travels: eight bytes of PD header, then the data.
PDs that follow each other in a frame also follow each other here, so that one copy takes them all.
Behind them lie the inputs of slaves, bit for bit as in their PDOs, with padding, so that a bus and
an image of the same order are one copy; then their outputs, in the region of their writer.  Where
one slave's outputs have several writers, each region mirrors all of them and holds its own.

An RxPD may have alternates: other layouts that are taken while its sender changes from one to the
other.  What both have goes to its place in the image, and so does the quality, which says how old
it is; what only the RxPD has keeps its value, and its PD header in the image stays as it was.

Behind all regions are samples: copies of the regions in the latest cycles, taken on request.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import DataType, Plain
from eap.codec.pd import PdHeader
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.spec import (
    Authentication,
    BusEntrySpec,
    FieldSource,
    RxAlternateSpec,
    RxPdSpec,
    SpecRecord,
    StationSpec,
    Substitute,
    TxFrameSpec,
    VariableSpec,
    Writer,
    encode_in_steps,
)
from eap.pd.words import FrameWord, RxWord, StationWord, TxWord

# Header first, at fixed offsets: a program of another release finds the version, and stops, before
# it relies on anything else.
MAGIC = b"EAPIMAGE"
LAYOUT_VERSION = 7
HEADER = struct.Struct("<8sIIQQQ")
"""Magic, layout version, generation, offset and length of the directory, size of the file."""
WORDS_OFFSET = 64

SAMPLE_HEAD = 16
SAMPLES_FOR_US = 1_000_000
"""Age of the oldest sample, unless that takes too much memory."""
MIN_SAMPLES, MAX_SAMPLES = 8, 1024
SAMPLES_SIZE = 1 << 20
"""Bytes that more than MIN_SAMPLES may take."""

VAR_CTRL = ".VarCtrl"
"""Suffix of the control variable of a TxPD: bit 0 suppresses it, a rising bit 1 sends it."""
FRAME_CTRL = ".FrameCtrl"
"""Suffix of the control variable of a TxFrame: bit 0 suppresses it."""


class VariableSlot(SpecRecord, frozen=True):
    """One variable: *bit_offset* counts from the start of the image."""

    name: str
    type: str
    writer: Writer
    bit_offset: int
    unit: str = ""
    comment: str = ""
    default: Plain | None = None


class RegionSlot(SpecRecord, frozen=True):
    """The variables of one writer, and the word that guards them; offsets in bytes."""

    offset: int
    size: int
    sequence: int


class SampleSlot(SpecRecord, frozen=True):
    """Samples of all regions, one a cycle; offsets and sizes in bytes.

    The sample of a cycle lies at ``offset + cycle % count * size``: the cycle and its time, which
    take 16 bytes, then the image from *first* to *last*.
    """

    offset: int
    count: int
    size: int
    first: int
    last: int


class ImagePort(SpecRecord, frozen=True):
    """Facts on a port for readers of the image."""

    name: str
    kind: str
    net_id: str
    interface: str


class FrameSlot(SpecRecord, frozen=True):
    """A TxFrame: *words* is the index of its first word."""

    name: str
    port: str
    destination: str
    words: int
    monitor_interval_ms: int = 0
    monitor_ip: str = ""

    @property
    def target(self) -> tuple[str, str, int, str]:
        """Subscriber whose presence is monitored."""
        return self.port, self.destination, self.monitor_interval_ms, self.monitor_ip


class TxSlot(SpecRecord, frozen=True):
    """A TxPD; *frame_words* is the index of its frame's first word, *size* the data's bytes."""

    name: str
    frame: str
    port: str
    pd_id: int
    version: int
    size: int
    variables: tuple[str, ...]
    words: int
    frame_words: int
    by_schedule: bool
    """True if cycle time or divider is its only trigger."""
    cyclic: bool
    """True if that schedule is a cycle time (or each cycle), not a divider."""
    event: bool
    """True if the application can send it."""
    poll_request: str = ""
    """The RxPD that requests it."""
    period_us: int = 0
    """Distance of its frames where schedule is its only trigger, else 0."""


class RxSlot(SpecRecord, frozen=True):
    """An RxPD: its PD header lies at byte *offset*, its data behind it."""

    name: str
    port: str
    pd_id: int
    version: int
    publisher: str
    size: int
    variables: tuple[str, ...]
    words: int
    offset: int
    step: int
    sender_cycle_us: int
    timeout_ms: int
    substitute: Substitute
    poll_request: str = ""
    """The TxPD that requests it."""
    alternates: tuple[AlternateSlot, ...] = ()
    source: str = ""
    """Address that its frames must come from; empty takes any."""
    auth: Authentication = Authentication.OFF


class FieldSlot(SpecRecord, frozen=True):
    """A source in a controller: word *words* has the monotonic time of its newest value, 0 if none.

    Services writes the word.
    """

    variable: str
    """A variable, or a part of one."""
    controller: str
    timeout_ms: int
    words: int


class ImageLayout(SpecRecord, frozen=True):
    """The directory of one station's image."""

    station: str
    net_id: str
    cycle_us: int
    ports: tuple[ImagePort, ...]
    variables: tuple[VariableSlot, ...]
    regions: dict[Writer, RegionSlot]
    frames: tuple[FrameSlot, ...]
    tx: tuple[TxSlot, ...]
    rx: tuple[RxSlot, ...]
    samples: SampleSlot
    word_count: int
    directory_offset: int
    fields: tuple[FieldSlot, ...] = ()

    def encode(self) -> bytes:
        """Return the directory as stored in the image."""
        return encode_in_steps(self)

    @property
    def size(self) -> int:
        """Bytes of the whole image."""
        return self.directory_offset + len(self.encode())


def plan_layout(spec: StationSpec) -> ImageLayout:
    """Assign an offset to everything in *spec*.

    Raises:
        ValueError: an alternate of an RxPD does not belong to it.
    """
    words = _Allocator(0)
    words.take(StationWord.SIZE)
    frames = tuple(_frame_slot(frame, words) for frame in spec.frames)
    types = {variable.name: datatypes.parse(variable.type) for variable in spec.variables}
    tx = tuple(_tx_slots(spec, frames, types, words))
    # In one piece, so that a slice with a stride reaches one word of all RxPDs.
    rx_words = [words.take(RxWord.SIZE) for _ in spec.subscriptions]
    fields = tuple(
        FieldSlot(each.variable, each.controller, each.timeout_ms, words.take(1))
        for each in spec.sources
        if isinstance(each, FieldSource)
    )

    octets = _Allocator(WORDS_OFFSET + 8 * words.used)
    start = octets.used
    slots: dict[str, VariableSlot] = {}
    # First in the region and in frame order, so that one copy takes all PDs of a frame.
    rx = tuple(_rx_slots(spec, rx_words, slots, octets))
    regions = {}
    for writer in Writer:
        _lay_out_on_bus(spec, writer, types, slots, octets)
        _lay_out_variables(
            (v for v in spec.variables if v.writer is writer and v.name not in slots),
            slots,
            octets,
        )
        # Control variables are commands of the application; it writes them, and the engine reads
        # them.
        if writer is Writer.APPLICATION:
            _lay_out_variables(_control_variables(spec), slots, octets)
        # Words are loaded and stored whole only at multiples of 8, and samples begin with words.
        octets.align()
        sequence = StationWord[f"{writer.name}_SEQUENCE"]
        regions[writer] = RegionSlot(start, octets.used - start, sequence)
        start = octets.used
    samples = _sample_slot(regions[Writer.ENGINE].offset, octets, spec.cycle_us)

    return ImageLayout(
        station=spec.name,
        net_id=str(spec.net_id),
        cycle_us=spec.cycle_us,
        ports=tuple(ImagePort(p.name, p.kind, str(p.net_id), str(p.interface)) for p in spec.ports),
        variables=tuple(slots.values()),
        regions=regions,
        frames=frames,
        tx=tx,
        rx=rx,
        samples=samples,
        word_count=words.used,
        directory_offset=octets.used,
        fields=fields,
    )


class _Allocator:
    """Hands out consecutive units."""

    def __init__(self, start: int) -> None:
        self.used = start

    def take(self, size: int) -> int:
        start = self.used
        self.used += size
        return start

    def align(self) -> None:
        self.used += -self.used % 8


def _sample_slot(first: int, octets: _Allocator, cycle_us: int) -> SampleSlot:
    """Keep enough samples for a reader that looks now and then, in not too much memory."""
    last = octets.used
    size = SAMPLE_HEAD + last - first
    count = min(SAMPLES_FOR_US // cycle_us, MAX_SAMPLES, SAMPLES_SIZE // size)
    count = max(count, MIN_SAMPLES)
    return SampleSlot(octets.take(count * size), count, size, first, last)


def _control_variables(spec: StationSpec) -> Iterable[VariableSpec]:
    for frame in spec.frames:
        yield VariableSpec(frame.name + FRAME_CTRL, "UINT", comment="bit 0: suppress the frame")
        for pd in frame.pds:
            yield VariableSpec(
                pd.name + VAR_CTRL, "UINT", comment="bit 0: suppress the PD; rising bit 1: send it"
            )


def _lay_out_variables(
    variables: Iterable[VariableSpec], slots: dict[str, VariableSlot], octets: _Allocator
) -> None:
    for variable in variables:
        offset = octets.take(datatypes.parse(variable.type).size)
        slots[variable.name] = _variable_slot(variable, 8 * offset)


def _lay_out_on_bus(
    spec: StationSpec,
    writer: Writer,
    types: dict[str, datatypes.DataType],
    slots: dict[str, VariableSlot],
    octets: _Allocator,
) -> None:
    """Lay out the slaves' process data that *writer* writes: all inputs, then outputs."""
    slaves = [slave for port in spec.ports if port.bus for slave in port.bus.slaves]
    sides: list[tuple[BusEntrySpec, ...]] = [slave.inputs for slave in slaves]
    sides += [slave.outputs for slave in slaves]
    named = {variable.name: variable for variable in spec.variables if variable.writer is writer}
    for entries in sides:
        own = [entry.variable for entry in entries if entry.variable in named]
        if own:
            plan = mirror(entries, types)
            first_bit = 8 * octets.take(plan.size)
            for name in own:
                slots[name] = _variable_slot(named[name], first_bit + plan.bit_offsets[name])


def _variable_slot(variable: VariableSpec, bit_offset: int) -> VariableSlot:
    return VariableSlot(
        variable.name,
        variable.type,
        variable.writer,
        bit_offset,
        variable.unit,
        variable.comment,
        variable.default,
    )


def _frame_slot(frame: TxFrameSpec, words: _Allocator) -> FrameSlot:
    return FrameSlot(
        name=frame.name,
        port=frame.port,
        destination=frame.destination,
        words=words.take(FrameWord.SIZE),
        monitor_interval_ms=frame.monitor_interval_ms,
        monitor_ip=frame.monitor_ip,
    )


def _tx_slots(
    spec: StationSpec,
    frames: tuple[FrameSlot, ...],
    types: dict[str, datatypes.DataType],
    words: _Allocator,
) -> Iterable[TxSlot]:
    for frame, slot in zip(spec.frames, frames, strict=True):
        for pd in frame.pds:
            trigger = pd.trigger
            by_schedule = not (trigger.on_change or trigger.event or pd.poll_request)
            period_us = trigger.cycle_us or spec.cycle_us * (trigger.divider or 1) * (
                frame.divider or 1
            )
            yield TxSlot(
                name=pd.name,
                frame=frame.name,
                port=frame.port,
                pd_id=pd.pd_id,
                version=pd.version,
                size=datatypes.layout([types[name] for name in pd.variables]).size,
                variables=pd.variables,
                words=words.take(TxWord.SIZE),
                frame_words=slot.words,
                by_schedule=by_schedule,
                event=trigger.event,
                cyclic=bool(trigger.cycle_us) or not (trigger.divider or frame.divider),
                poll_request=pd.poll_request,
                period_us=period_us if by_schedule else 0,
            )


def _rx_slots(
    spec: StationSpec,
    words: list[int],
    slots: dict[str, VariableSlot],
    octets: _Allocator,
) -> Iterable[RxSlot]:
    named = {variable.name: variable for variable in spec.variables}
    for pd, first_word in zip(spec.subscriptions, words, strict=True):
        kinds = [datatypes.parse(named[name].type) for name in pd.variables]
        plan = datatypes.layout(kinds)
        offset = octets.take(PdHeader.SIZE + plan.size)
        data = 8 * (offset + PdHeader.SIZE)
        bits = [data + bit_offset for bit_offset in plan.bit_offsets]
        for name, bit_offset in zip(pd.variables, bits, strict=True):
            slots[name] = _variable_slot(named[name], bit_offset)
        yield RxSlot(
            name=pd.name,
            port=pd.port,
            pd_id=pd.pd_id,
            version=pd.version,
            publisher=pd.publisher,
            size=plan.size,
            variables=pd.variables,
            words=first_word,
            offset=offset,
            step=pd.step,
            sender_cycle_us=pd.sender_cycle_us,
            timeout_ms=pd.timeout_ms,
            substitute=pd.substitute,
            poll_request=pd.poll_request,
            alternates=lay_out_alternates(pd, kinds, bits, offset),
            source=pd.source,
            auth=pd.auth,
        )


_QUALITY_BITS = 16
"""The quality is the last field of a PD header."""
_QUALITY = 8 * PdHeader.SIZE - _QUALITY_BITS


class AlternateSlot(SpecRecord, frozen=True):
    """Another layout: *size* bytes of data."""

    version: int
    size: int
    moves: tuple[Move, ...]
    """From bits of the PD, header included, to bits of the image."""
    untouched: tuple[tuple[int, int], ...]
    """Variables of the RxPD that it does not bring: first bit in the image, and how many."""

    def copy_plan(self) -> CopyPlan:
        """Return the plan that copies a PD of this layout, header included, to the image."""
        return CopyPlan(self.moves, used=self.untouched)


def lay_out_alternates(
    pd: RxPdSpec, kinds: Sequence[DataType], bits: Sequence[int], offset: int
) -> tuple[AlternateSlot, ...]:
    """Return the slots of the alternates of *pd*.

    Args:
        pd: The RxPD.
        kinds: Types of its variables, in PDO order.
        bits: Where they lie in the image.
        offset: Byte of the image at which its PD header lies.

    Raises:
        ValueError: an alternate brings what *pd* has not, or has as another type; or the same
            variable twice; or version and size are those of another layout.
    """
    if not pd.alternates:
        return ()
    own = dict(zip(pd.variables, zip(kinds, bits, strict=True), strict=True))
    layouts = {(pd.version, datatypes.layout(kinds).size)}
    found = []
    for alternate in pd.alternates:
        found.append(_lay_out_alternate(pd, alternate, own, 8 * offset))
        key = found[-1].version, found[-1].size
        if key in layouts:
            problem = f"has {key[1]} bytes like another layout of that version"
            raise _alternate_error(pd, alternate, problem, "another version")
        layouts.add(key)
    return tuple(found)


def _lay_out_alternate(
    pd: RxPdSpec, alternate: RxAlternateSpec, own: Mapping[str, tuple[DataType, int]], header: int
) -> AlternateSlot:
    theirs = [datatypes.parse(each.type) for each in alternate.variables]
    plan = datatypes.layout(theirs)
    moves = [Move(_QUALITY, header + _QUALITY, _QUALITY_BITS)]
    missing = dict(own)
    for each, kind, start in zip(alternate.variables, theirs, plan.bit_offsets, strict=True):
        # A variable without a name is a gap of the other layout: it only moves those behind it.
        if not each.name:
            continue
        expected, bit = missing.pop(each.name, (None, 0))
        if kind != expected:
            shown = ", ".join(f"{name} ({own[name][0].text})" for name in own)
            problem = f"brings {each.name} ({kind.text})"
            raise _alternate_error(pd, alternate, problem, f"each of {shown} at most once")
        moves.append(Move(8 * PdHeader.SIZE + start, bit, kind.bit_length))
    untouched = tuple((bit, kind.bit_length) for kind, bit in missing.values())
    return AlternateSlot(alternate.version, plan.size, tuple(moves), untouched)


def _alternate_error(
    pd: RxPdSpec, alternate: RxAlternateSpec, problem: str, expected: str
) -> ValueError:
    which = f"alternate of version {alternate.version} of RxPD {pd.name!r}"
    return ValueError(f"{which} {problem}, expected {expected}")


class Mirror(NamedTuple):
    """One direction of a slave's process data."""

    bit_offsets: dict[str, int]
    """Of each variable, from where the slave's part begins."""
    size: int
    """In bytes."""


def mirror(entries: Iterable[BusEntrySpec], types: Mapping[str, DataType]) -> Mirror:
    """Place the variables of *entries*.

    A variable that is no bit field starts on a whole byte, as everywhere in an image.  Behind an
    entry that is not aligned so on the slave, all others are shifted.
    """
    offsets: dict[str, int] = {}
    end = 0
    for entry in entries:
        if entry.variable:
            # Readers take all other types by whole bytes (struct), and never shift.
            if not types[entry.variable].is_bits:
                end = -(-end // 8) * 8
            offsets[entry.variable] = end
        end += entry.bit_length
    return Mirror(offsets, -(-end // 8))
