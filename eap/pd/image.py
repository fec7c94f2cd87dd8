"""The process image of one station: every variable and every counter, in shared memory.

Rule 1: each region of variables has one writer, which makes its sequence word odd while it writes.
Rule 2: a reader copies, then checks that the word was even and is unchanged.  If not, it retries a
bounded number of times, and then names the writer that stopped in the middle.
Rule 3: counters are single words with a single writer; several of them that belong together are
read from a snapshot, which is taken between two cycles.
Rule 4: the engine waits for no writer.  Its :class:`Inputs` copy what others write at the start of
a cycle, when a sequence word moved, and keep the last whole copy while a writer writes.
Rule 5: the engine takes samples of all variables at the end of a cycle as long as a reader asks for
them, and never waits for a reader: a slow one finds that the slot of a sample holds a later one.  A
sample is taken with the copies that the cycle itself has read, so that its values belong to one
moment, for all writers.  Any number of readers share the samples: reading takes none away, and all
extend the same term by the same time.

This module works on any writable buffer; ``eap.net.image_file`` maps one from a file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import msgspec

from eap.codec import datatypes
from eap.codec.datatypes import DataType, find_variable, split_paths
from eap.errors import ImageError, TornReadError
from eap.pd import ordering
from eap.pd.layout import (
    HEADER,
    LAYOUT_VERSION,
    MAGIC,
    SAMPLE_HEAD,
    WORDS_OFFSET,
    ImageLayout,
    VariableSlot,
)
from eap.pd.spec import Writer
from eap.pd.words import StationWord
from eap.suggest import nearest_in_any_case

READ_ATTEMPTS = 1000
"""Spread over a tenth of a second by the pauses of a mapped file: a busy host stalls that long."""
SNAPSHOT_ATTEMPTS = 200
"""Fewer, because the reader of snapshots has other clients, and gets a copy in any case."""

MAX_PARTS = 10_000
"""Parts of variables that an image remembers."""

_CODES = {
    (int, 1): "b", (int, 2): "h", (int, 4): "i", (int, 8): "q", (float, 4): "f", (float, 8): "d",
}  # fmt: skip
"""Of those numbers that one call packs; capitals for those without a sign."""

_CYCLE, _FUTEX, _SEQUENCE = StationWord.CYCLE, StationWord.FUTEX, StationWord.ENGINE_SEQUENCE


def _near_variable(name: str, known: Iterable[str]) -> str:
    """Return a hint to the variable that *name*, or the start of a path, comes near to."""
    for each in (name, *(variable for variable, _ in split_paths(name))):
        near = nearest_in_any_case(each, known)
        if near is not None:
            return f", did you mean {near}{name[len(each) :]}?"
    return ""


def _no_pause() -> None:
    """Try again at once."""


class Image:
    """Named access to the memory that an :class:`ImageLayout` describes.

    Args:
        memory: At least ``layout.size`` bytes, already formatted.
        layout: Offsets of words and variables.
        pause: Called between two attempts at a read; a driver gives the processor away here.
    """

    def __init__(
        self, memory: memoryview, layout: ImageLayout, *, pause: Callable[[], None] = _no_pause
    ) -> None:
        self.memory = memory
        self.layout = layout
        self.words = memory[WORDS_OFFSET : WORDS_OFFSET + 8 * layout.word_count].cast("q")
        self.slots = {slot.name: slot for slot in layout.variables}
        self._parts: dict[str, VariableSlot] = {}
        self._pause = pause

    def slot(self, name: str) -> VariableSlot:
        """Return a variable, or a part of one at a path such as ``axis.position``.

        Raises:
            ImageError: there is none of that name.
        """
        slot = self.slots.get(name) or self._parts.get(name)
        if slot is None:
            # A client may write one path in many ways.
            if len(self._parts) >= MAX_PARTS:
                self._parts.clear()
            slot = self._parts[name] = self._find_part(name)
        return slot

    def _find_part(self, name: str) -> VariableSlot:
        def type_of(variable: str) -> DataType | None:
            slot = self.slots.get(variable)
            return None if slot is None else datatypes.parse(slot.type)

        station = self.layout.station
        try:
            found = find_variable(name, type_of)
        except ValueError as exc:
            raise ImageError(f"station {station} has no {name!r}: {exc}") from None
        if found is None:
            hint = _near_variable(name, self.slots)
            raise ImageError(f"station {station} has no variable {name!r}{hint}")
        slot, part = self.slots[found[0]], found[1]
        return VariableSlot(name, part.kind.text, slot.writer, slot.bit_offset + part.bit_offset)

    def region(self, writer: Writer) -> memoryview:
        """Return the variables of *writer*, live."""
        slot = self.layout.regions[writer]
        return self.memory[slot.offset : slot.offset + slot.size]

    def updated_region(self, writer: Writer, values: Mapping[str, Any]) -> bytearray:
        """Return a copy of the region of *writer*, who calls this, with *values* in it.

        Raises:
            ValueError: a value does not fit its type.
            ImageError: there is no such variable, or another writer has it.
        """
        fresh, start = bytearray(self.region(writer)), 8 * self.layout.regions[writer].offset
        view = memoryview(fresh)
        for name, value in values.items():
            slot = self.slot(name)
            if slot.writer is not writer:
                raise ImageError(f"{name} is written by the {slot.writer}, not by the {writer}")
            kind = datatypes.parse(slot.type)
            put(view, slot.bit_offset - start, kind.bit_length, kind.encode(value))
        return fresh

    def read(self, name: str) -> Any:
        """Return one variable's value; raise ImageError if there is none of that name."""
        return datatypes.parse(self.slot(name).type).decode(self.load(name), 0)

    def load(self, name: str, *, attempts: int = READ_ATTEMPTS) -> bytes:
        """Return one variable's encoded bytes, in the form of :meth:`encode`.

        Raises:
            ImageError: there is none of that name; TornReadError, if it is only for now.
        """
        slot = self.slot(name)
        first, last = slot.bit_offset // 8, _end_octet(slot)
        return extract_value(slot, self._stable_copy(slot.writer, first, last, attempts), 8 * first)

    def read_all(self, writers: Collection[Writer] = tuple(Writer)) -> dict[str, Any]:
        """Return all variables of *writers*; those of one writer belong to one moment."""
        return self.read_slots(self.layout.variables, writers)

    def read_slots(
        self, slots: Iterable[VariableSlot], writers: Collection[Writer]
    ) -> dict[str, Any]:
        """Return those of *slots* that *writers* write; those of one belong to one moment."""
        values = {}
        copies = {}
        for writer in writers:
            region = self.layout.regions[writer]
            copies[writer] = self._stable_copy(writer, region.offset, region.offset + region.size)
        for slot in slots:
            if slot.writer in copies:
                region = self.layout.regions[slot.writer]
                values[slot.name] = _decode(slot, copies[slot.writer], 8 * region.offset)
        return values

    def try_snapshot(self) -> Image | None:
        """Return a copy of all words and variables, None while the engine changes them.

        The copy is that of a moment between two cycles: the word FUTEX has followed CYCLE, and no
        frame is being taken.  What services and applications write may be in between.
        """
        words = self.words
        cycle, sequence = words[_CYCLE], words[_SEQUENCE]
        if sequence % 2 or words[_FUTEX] != cycle & 0xFFFFFFFF:
            return None
        # Copied without a lock and checked afterwards: the engine never waits for a reader.
        ordering.keep_order()
        copy = self._copy()
        ordering.keep_order()
        return copy if words[_SEQUENCE] == sequence and words[_CYCLE] == cycle else None

    def snapshot(self) -> Image:
        """Return a copy as :meth:`try_snapshot` does, after a bounded number of attempts.

        If the engine stopped in the middle of a cycle, the copy is what it left.
        """
        for _ in range(SNAPSHOT_ATTEMPTS):
            if copy := self.try_snapshot():
                return copy
            self._pause()
        return self._copy()

    def _copy(self) -> Image:
        return Image(memoryview(bytes(self.memory[: self.layout.samples.last])), self.layout)

    def write(self, name: str, value: Any) -> None:
        """Store one value; raise ValueError if the type cannot hold it.

        The caller is the region's writer, inside a block of :meth:`writing`.
        """
        self.store(name, self.encode(name, value))

    def encode(self, name: str, value: Any) -> bytes:
        """Return the bytes of *value* for :meth:`store`; raise ValueError if it does not fit."""
        return datatypes.parse(self.slot(name).type).encode(value)

    def store(self, name: str, octets: bytes) -> None:
        """Store encoded bytes in a variable, inside a block of :meth:`writing`."""
        slot = self.slot(name)
        put(self.memory, slot.bit_offset, datatypes.parse(slot.type).bit_length, octets)

    def storer(self, name: str) -> Callable[[Any], None]:
        """Return a function that stores numbers in one variable; they must fit its type."""
        slot = self.slot(name)
        kind = datatypes.parse(slot.type)
        limits = kind.scalar_range
        code = "" if limits is None or kind.is_bits else _CODES.get((type(limits[0]), kind.size))
        if not code:
            return lambda value: self.store(name, kind.encode(value))
        if limits is not None and limits[0] >= 0:
            code = code.upper()
        return partial(struct.Struct(f"<{code}").pack_into, self.memory, slot.bit_offset // 8)

    @contextmanager
    def writing(self, writer: Writer) -> Iterator[None]:
        """Mark the region of *writer* as changing while the block runs."""
        sequence = self.layout.regions[writer].sequence
        # A predecessor that was killed in the middle left an odd word; odd it stays until we end.
        self.words[sequence] += 1 + self.words[sequence] % 2
        ordering.keep_order()
        try:
            yield
        finally:
            ordering.keep_order()
            self.words[sequence] += 1

    def release(self) -> None:
        """Free the slots one by one; nothing can be read or written any more."""
        while self.slots:
            self.slots.popitem()
        self._parts.clear()

    def set_defaults(self) -> None:
        """Store the default of every variable that has one; for a fresh image."""
        for slot in self.layout.variables:
            if slot.default is not None:
                self.write(slot.name, default_value(slot))

    def _stable_copy(
        self, writer: Writer, first: int, last: int, attempts: int = READ_ATTEMPTS
    ) -> bytes:
        words, sequence = self.words, self.layout.regions[writer].sequence
        for _ in range(attempts):
            # A sequence lock: a writer never waits for a reader, so the engine cannot be held up.
            before = words[sequence]
            if not before % 2:
                ordering.keep_order()
                data = bytes(self.memory[first:last])
                ordering.keep_order()
                if words[sequence] == before:
                    return data
            self._pause()
        raise TornReadError(
            f"station {self.layout.station}: the {writer} stopped in the middle of writing its "
            f"variables; they are not consistent until it writes again",
            writer=writer,
        )


def put(memory: memoryview, bit_offset: int, bit_length: int, octets: bytes) -> None:
    """Store an encoded value without touching the bits beside it."""
    offset, bit = divmod(bit_offset, 8)
    end = -(-(bit_offset + bit_length) // 8)
    if not bit and not bit_length % 8:
        memory[offset:end] = octets
        return
    # Adjacent bits may belong to other variables: read, mask and write back.
    mask = (1 << bit_length) - 1 << bit
    word = int.from_bytes(memory[offset:end], "little") & ~mask | octets[0] << bit
    memory[offset:end] = word.to_bytes(end - offset, "little")


def format_image(memory: memoryview, layout: ImageLayout, generation: int) -> Image:
    """Write header, directory and default values into zeroed *memory*."""
    directory = layout.encode()
    offset = layout.directory_offset
    memory[offset : offset + len(directory)] = directory
    image = Image(memory, layout)
    image.set_defaults()
    # The header comes last: a file without magic is one whose making was interrupted.
    size = offset + len(directory)
    HEADER.pack_into(memory, 0, MAGIC, LAYOUT_VERSION, generation, offset, len(directory), size)
    return image


def read_header(memory: memoryview) -> tuple[ImageLayout, int]:
    """Return the layout and the generation of a formatted image.

    Raises:
        ImageError: it is no image, of another layout version, or damaged.
    """
    if len(memory) < WORDS_OFFSET:
        raise ImageError("not a process image: it is shorter than the header")
    magic, version, generation, offset, length, size = HEADER.unpack_from(memory)
    if magic != MAGIC:
        raise ImageError("not a process image: the magic is missing")
    if version != LAYOUT_VERSION:
        raise ImageError(
            f"process image of layout version {version}, this program knows {LAYOUT_VERSION}: "
            f"use the same release of eap-appliance on both sides"
        )
    if size > len(memory) or offset + length > size:
        raise ImageError(f"process image is cut off: {len(memory)} bytes of {size}")
    try:
        layout = msgspec.json.decode(memory[offset : offset + length], type=ImageLayout)
    except ValueError as exc:
        raise ImageError(f"process image has a damaged directory: {exc}") from None
    samples = layout.samples
    ends = (
        (WORDS_OFFSET + 8 * layout.word_count, samples.first),
        (samples.last, samples.offset),
        (samples.offset + samples.count * samples.size, offset),
    )
    # A damaged directory must not lead readers to offsets outside the regions.
    if layout.directory_offset != offset or any(end > start for end, start in ends):
        raise ImageError("process image has a damaged directory: it contradicts the header")
    return layout, generation


def read_generation(memory: memoryview) -> int:
    """Return the generation of an image that is known to be formatted."""
    return int(HEADER.unpack_from(memory)[2])


def default_value(slot: VariableSlot) -> Any:
    """Return the value that *slot* starts with; zero if it names none."""
    kind = datatypes.parse(slot.type)
    return kind.zero if slot.default is None else kind.from_plain(slot.default)


def _end_octet(slot: VariableSlot) -> int:
    return -(-(slot.bit_offset + datatypes.parse(slot.type).bit_length) // 8)


def extract_value(slot: VariableSlot, data: bytes, first_bit: int) -> bytes:
    """Return the bytes of a variable out of *data*, a copy of the image from *first_bit* on."""
    kind = datatypes.parse(slot.type)
    offset, bit = divmod(slot.bit_offset - first_bit, 8)
    if not kind.is_bits:
        return data[offset : offset + kind.size]
    # A bit field of up to 8 bits may reach into the next byte.
    word = int.from_bytes(data[offset : offset + 2], "little") >> bit
    return bytes((word & (1 << kind.bit_length) - 1,))


def _decode(slot: VariableSlot, data: bytes, first_bit: int) -> Any:
    return datatypes.parse(slot.type).decode(extract_value(slot, data, first_bit), 0)


_TORN = int(StationWord.TORN)
_SERVICES = int(StationWord.SERVICES_SEQUENCE)
_APPLICATION = int(StationWord.APPLICATION_SEQUENCE)


class Inputs:
    """Copies of the variables that services and applications write, stable within a cycle.

    Attributes:
        memory: With variables at the same offsets as in the image.  What the engine itself writes
            must be read from there instead.
    """

    def __init__(self, image: Image) -> None:
        self._image = image
        self._words = image.words
        self.memory = memoryview(bytearray(image.layout.samples.last))
        self._regions = [
            (slot.sequence, slice(slot.offset, slot.offset + slot.size))
            for writer, slot in image.layout.regions.items()
            if writer is not Writer.ENGINE and slot.size
        ]
        # No sequence word is negative: the first refresh copies every region.
        self._seen = [-1] * len(self._regions)
        self._settled: tuple[int, ...] = ()
        """Both sequence words, when all that they guard has been copied."""
        for _, region in self._regions:
            self.memory[region] = image.memory[region]

    def reload(self) -> None:
        """Copy the values that were put into the image before its writers write there."""
        # A handover wrote the values without touching the sequence words, so these prove nothing
        # here.
        for index, (sequence, region) in enumerate(self._regions):
            if self.memory[region] == self._image.memory[region]:
                self._seen[index] = self._words[sequence]
            else:
                self.memory[region] = self._image.memory[region]
                self._seen[index] = -1

    def refresh(self) -> bool:
        """Copy what changed; return whether anything did."""
        words = self._words
        sequences = words[_SERVICES], words[_APPLICATION]
        if sequences == self._settled:
            return False
        changed = self._copy_changed()
        if all(
            seen == sequences[sequence - _SERVICES]
            for (sequence, _), seen in zip(self._regions, self._seen, strict=True)
        ):
            self._settled = sequences
        return changed

    def _copy_changed(self) -> bool:
        words = self._words
        changed = False
        for index, (sequence, region) in enumerate(self._regions):
            before = words[sequence]
            if before == self._seen[index]:
                continue
            if before % 2:
                # The previous whole copy stays in use: a cycle never waits for a program that
                # writes.
                words[_TORN] += 1
                continue
            ordering.keep_order()
            copy = bytes(self._image.memory[region])
            ordering.keep_order()
            if words[sequence] != before:
                continue  # a new write began meanwhile; the next cycle has it
            self.memory[region] = copy
            self._seen[index] = before
            changed = True
        return changed


_SAMPLED_UNTIL = int(StationWord.SAMPLED_UNTIL)
_NO_CYCLE = 0
"""In the head of a sample that is being taken: the first cycle of a station is 1."""


class Sampler:
    """The engine's side of the samples.

    Args:
        image: Where the variables and the samples are.
        inputs: The cycle's copy of what others write, at the same offsets.
    """

    def __init__(self, image: Image, inputs: memoryview) -> None:
        self._words = image.words
        self._memory = image.memory
        self._inputs = inputs
        self._slot = slot = image.layout.samples
        self._heads = _heads(image)
        engine = image.layout.regions[Writer.ENGINE]
        self._engine = slice(engine.offset, engine.offset + engine.size)
        self._others = slice(engine.offset + engine.size, slot.last)

    def end_cycle(self, cycle: int, now_ns: int) -> None:
        """Keep the variables as they are after *cycle*, which ran at *now_ns*, if wanted."""
        if cycle <= self._words[_SAMPLED_UNTIL]:
            self._take(cycle, now_ns)

    def _take(self, cycle: int, now_ns: int) -> None:
        slot, memory = self._slot, self._memory
        number = cycle % slot.count
        head = number * (slot.size // 8)
        # The cycle number is cleared first and written last: a reader that sees the same number
        # before and after its copy has a whole sample.
        self._heads[head] = _NO_CYCLE
        ordering.keep_order()
        self._heads[head + 1] = now_ns
        start = slot.offset + number * slot.size + SAMPLE_HEAD
        middle = start + self._engine.stop - self._engine.start
        memory[start:middle] = memory[self._engine]
        memory[middle : start - SAMPLE_HEAD + slot.size] = self._inputs[self._others]
        ordering.keep_order()
        self._heads[head] = cycle


SAMPLING_TERM_US = 1_000_000
"""Time that the engine goes on sampling for readers that do not extend it."""


class ImageSamples:
    """The side of one reader of the samples; readers do not affect each other.

    Args:
        image: Where they are.

    Attributes:
        image: The same.
    """

    def __init__(self, image: Image) -> None:
        self.image = image
        self._slot = image.layout.samples
        self._heads = _heads(image)

    @property
    def newest(self) -> int:
        """The cycle that ran last, or runs right now."""
        return int(self.image.words[_CYCLE])

    def extend(self) -> None:
        """Have samples taken for SAMPLING_TERM_US from now on; call it several times in that."""
        # One word for all readers: every one sets the same term, so the last to write it takes
        # nothing away from the others, but for the moment between its reading and its writing.
        cycles = 2 + SAMPLING_TERM_US // self.image.layout.cycle_us
        words, until = self.image.words, self.newest + cycles
        words[_SAMPLED_UNTIL] = max(words[_SAMPLED_UNTIL], until)

    @property
    def count(self) -> int:
        """Number of cycles that samples are kept of."""
        return self._slot.count

    def since(self, cycle: int) -> range:
        """Return the cycles behind *cycle* that there may be samples of, the oldest first."""
        newest = self.newest
        if self._heads[self._head(newest)] != newest:
            newest -= 1  # it runs right now
        return range(max(cycle, newest - self._slot.count) + 1, newest + 1)

    def ran_at_ns(self, cycle: int) -> int | None:
        """Return when *cycle* ran, on the monotonic clock; None if there is no sample of it."""
        head = self._head(cycle)
        at_ns = self._heads[head + 1]
        ordering.keep_order()
        return at_ns if self._heads[head] == cycle else None

    def read(self, cycle: int) -> bytes | None:
        """Return the variables at the end of *cycle*; None if there is no sample of it."""
        start = self._slot.offset + cycle % self._slot.count * self._slot.size + SAMPLE_HEAD
        # Copied first and checked afterwards: the engine may reuse the slot at any moment.
        data = bytes(self.image.memory[start : start - SAMPLE_HEAD + self._slot.size])
        ordering.keep_order()
        return data if self._heads[self._head(cycle)] == cycle else None

    def _head(self, cycle: int) -> int:
        return cycle % self._slot.count * (self._slot.size // 8)


def _heads(image: Image) -> memoryview:
    """Return the samples as words, which are stored and loaded whole."""
    slot = image.layout.samples
    return image.memory[slot.offset : slot.offset + slot.count * slot.size].cast("q")
