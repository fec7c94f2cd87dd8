"""Variables that the engine computes in each cycle: links between variables, and generators.

Rule 1: a link may read what an earlier one of the same cycle wrote; those that do not depend on
each other are copied together.
Rule 2: between numbers, a link with a scale or an offset, or from one type to another, computes its
value, rounds it if the target holds whole numbers, and keeps it within the limits of its type.  A
source that is infinite or not a number gives no value: the target keeps the old one, and the
station counts that.
Rule 3: every other link copies bits without regard to their type.
Rule 4: a generated value is a function of the station's time alone: of the number of cycle times
since the first cycle, whether or not a cycle ran in each of them.  So a late or skipped cycle slows
nothing down, and a restarted engine continues as if it had not stopped.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from math import isfinite
from typing import Any, NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.pd.compiledsources import SourceStep, compile_steps, number_step, random_step
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.image import Image
from eap.pd.layout import VariableSlot
from eap.pd.spec import (
    CounterSource,
    EngineSource,
    LinkSpec,
    RampSource,
    RandomSource,
    SineSource,
    Writer,
)
from eap.pd.words import StationWord

_HELD = int(StationWord.LINKS_HELD)


class _LinkEnd(NamedTuple):
    """One end of a link."""

    slot: VariableSlot
    kind: DataType
    memory: memoryview

    @property
    def octets(self) -> slice:
        """Bytes of a variable that is no bit field."""
        first = self.slot.bit_offset // 8
        return slice(first, first + self.kind.size)


class _BoundLink(NamedTuple):
    """A link between its ends, and the bits of the image that it reads and writes."""

    link: LinkSpec
    source: _LinkEnd
    target: _LinkEnd
    reads: range
    writes: range

    @property
    def is_computed(self) -> bool:
        """True if a number comes out that has to be computed."""
        link, source, target = self.link, self.source.kind, self.target.kind
        if link.scale != 1.0 or link.offset:
            return True
        # Equal types are copied even if they are numbers: a conversion would lose NaN and infinity.
        if link.bits or source == target or (link.swap and source.size == target.size):
            return False
        return source.scalar_range is not None and target.scalar_range is not None


class Links:
    """Runs all links of one station.

    Args:
        image: The station's image; every target is in the engine's region.
        memory_of: Returns where the variables of a writer are read.
        links: In the order in which they run.
    """

    def __init__(
        self, image: Image, memory_of: Callable[[Writer], memoryview], links: Iterable[LinkSpec]
    ) -> None:
        def end(name: str) -> _LinkEnd:
            slot = image.slot(name)
            return _LinkEnd(slot, datatypes.parse(slot.type), memory_of(slot.writer))

        bound = [_bind(link, end(link.source), end(link.target)) for link in links]
        self._steps = [step for stage in _stages(bound) for step in _steps(image, stage)]

    @property
    def steps(self) -> int:
        """Number of calls of a run."""
        return len(self._steps)

    def run(self) -> None:
        """Give every target its value; the engine's region is marked as changing."""
        for step in self._steps:
            step()


def _bind(link: LinkSpec, source: _LinkEnd, target: _LinkEnd) -> _BoundLink:
    first, where = source.slot.bit_offset, target.slot.bit_offset
    length, available = source.kind.bit_length, target.kind.bit_length
    each = _BoundLink(
        link, source, target, range(first, first + length), range(where, where + available)
    )
    if each.is_computed or link.swap:
        return each
    bits = link.bits or min(length - link.source_bit, available - link.target_bit)
    return each._replace(
        reads=each.reads[link.source_bit :][:bits], writes=each.writes[link.target_bit :][:bits]
    )


def _stages(bound: Iterable[_BoundLink]) -> list[list[_BoundLink]]:
    """Divide *bound* so that those of one stage can run in any order, stage after stage."""
    stages: list[list[_BoundLink]] = []
    read_in: dict[int, int] = {}
    written_in: dict[int, int] = {}
    for each in bound:
        # A link runs behind those that write what it reads, and behind all that read or write what
        # it writes: the result is that of running the links one after the other.
        before = [written_in[bit] for bit in each.reads if bit in written_in]
        for bit in each.writes:
            before += [stage[bit] for stage in (read_in, written_in) if bit in stage]
        number = max(before, default=-1) + 1
        for bit in each.reads:
            read_in[bit] = max(number, read_in.get(bit, 0))
        written_in.update(dict.fromkeys(each.writes, number))
        stages += [[] for _ in range(number + 1 - len(stages))]
        stages[number].append(each)
    return stages


def _steps(image: Image, stage: Iterable[_BoundLink]) -> Iterator[Callable[[], None]]:
    moves: dict[Writer, list[Move]] = {}
    memories: dict[Writer, memoryview] = {}
    for each in stage:
        source = each.source
        if each.is_computed:
            yield _computed(image, each)
        elif each.link.swap:
            yield _swapped(image.memory, each)
        else:
            writer = source.slot.writer
            memories[writer] = source.memory
            move = Move(each.reads.start, each.writes.start, len(each.writes))
            moves.setdefault(writer, []).append(move)
    for writer, memory in memories.items():
        yield partial(CopyPlan(moves[writer]).run, memory, image.memory)


def _swapped(memory: memoryview, each: _BoundLink) -> Callable[[], None]:
    reversed_octets = each.source.memory[each.source.octets][::-1]
    where = each.target.octets

    def copy() -> None:
        memory[where] = reversed_octets

    return copy


def _computed(image: Image, each: _BoundLink) -> Callable[[], None]:
    read = _reader(each.source, swap=each.link.swap)
    value = _conversion(each.link, each.source.kind, each.target.kind)
    store = image.storer(each.target.slot.name)
    words = image.words

    def compute() -> None:
        number = read()
        if isfinite(number):
            store(value(number))
        else:
            words[_HELD] += 1

    return compute


def _reader(source: _LinkEnd, *, swap: bool) -> Callable[[], Any]:
    memory, kind = source.memory, source.kind
    first, shift = divmod(source.slot.bit_offset, 8)
    if kind.is_bits:
        mask = (1 << kind.bit_length) - 1
        # A bit field may reach into the next byte; the slice is cut off at the end of the memory.
        two = memory[first : first + 2]
        return lambda: int.from_bytes(two, "little") >> shift & mask
    octets = memory[source.octets]
    if swap:
        backward = octets[::-1]
        return lambda: kind.decode(bytes(backward), 0)
    return lambda: kind.decode(octets, 0)


def _conversion(link: LinkSpec, source: DataType, target: DataType) -> Callable[[Any], Any]:
    """Return the function that computes the target's number from a finite one of the source."""
    low, high = target.scalar_range or (0, 0)
    rounds = isinstance(low, int)
    scale, offset = link.scale, link.offset
    if rounds and _is_whole(source) and scale.is_integer() and offset.is_integer():
        scale, offset = int(scale), int(offset)  # exact, also beyond the 53 bits of a float

    def compute(number: Any) -> Any:
        result = number * scale + offset
        if result < low:
            return low
        if result > high:
            return high
        return round(result) if rounds else float(result)

    return compute


def _is_whole(kind: DataType) -> bool:
    return kind.scalar_range is not None and isinstance(kind.scalar_range[0], int)


_POSITIONS = 65_537
"""Values of a random variable before they repeat: a prime, so that every stride visits all."""
_STRIDE = 40_503
"""Between the positions of one cycle and the next: far enough that their bytes do not overlap."""


class Generators:
    """Computes all generated variables of one station."""

    def __init__(self, image: Image, sources: Sequence[EngineSource]) -> None:
        compiled: list[tuple[SourceStep, Callable[[int], None]]] = []
        others: list[Callable[[int], None]] = []
        for source in sources:
            step, mine = _compiled_step(image, source), _generator_step(image, source)
            if step is None:
                others.append(mine)
            else:
                compiled.append((step, mine))
        reference = [mine for _, mine in compiled]
        run = compile_steps([step for step, _ in compiled], image.memory, partial(_run, reference))
        self._steps = [*(reference if run is None else [run]), *others]

    def run(self, tick: int) -> None:
        """Store the values of the time *tick*, in cycle times since the first cycle.

        The engine's region is marked as changing.
        """
        for step in self._steps:
            step(tick)


def _run(steps: Iterable[Callable[[int], None]], tick: int) -> None:
    for step in steps:
        step(tick)


def _compiled_step(image: Image, source: EngineSource) -> SourceStep | None:
    """Return the step for the compiled part, None if it has none for the source."""
    slot = image.slot(source.variable)
    kind, offset = datatypes.parse(slot.type), slot.bit_offset // 8
    if isinstance(source, RandomSource):
        sequence = _random_sequence(source.seed, kind.size)
        return random_step(offset, kind.size, _STRIDE, _POSITIONS, sequence)
    period_ms = 0 if isinstance(source, CounterSource) else source.period_ms
    return number_step(source, kind, offset, _cycles(period_ms, image.layout.cycle_us))


def _cycles(period_ms: float, cycle_us: int) -> float:
    """Return a period in cycles, at least one."""
    return max(period_ms * 1000 / cycle_us, 1.0)


def _generator_step(image: Image, source: EngineSource) -> Callable[[int], None]:
    slot = image.slot(source.variable)
    kind = datatypes.parse(slot.type)
    if isinstance(source, RandomSource):
        return _random_step(image, source, slot.bit_offset // 8, kind.size)
    limits = kind.scalar_range
    store = image.storer(slot.name)
    if limits is None or not isinstance(limits[0], int):
        return _number_step(source, image.layout.cycle_us, store)
    low, span = int(limits[0]), int(limits[1]) - int(limits[0]) + 1

    # Whole numbers wrap as the counter of a controller does, instead of staying at a limit.
    def wrap(value: float) -> None:
        store((round(value) - low) % span + low)

    if isinstance(source, CounterSource):
        step = source.step
        return lambda tick: store((tick * step - low) % span + low)
    return _number_step(source, image.layout.cycle_us, wrap)


@lru_cache(maxsize=32)
def _random_sequence(seed: int, size: int) -> bytes:
    """Return the bytes of all variables with this seed and size: one copy, since it is large."""
    return random.Random(seed).randbytes(_POSITIONS + size)  # noqa: S311  test data, not a secret


def _random_step(
    image: Image, source: RandomSource, offset: int, size: int
) -> Callable[[int], None]:
    """Store a piece of a fixed random sequence, at a position that follows from the time.

    Drawing new bytes in each cycle would tie the values to the number of cycles that ran, and
    takes longer for all but the smallest variables.
    """
    sequence = _random_sequence(source.seed, size)
    memory = image.memory[offset : offset + size]

    def fill(tick: int) -> None:
        # From the time alone (rule 4): a skipped cycle does not shift the values that follow.
        position = tick * _STRIDE % _POSITIONS
        memory[:] = sequence[position : position + size]

    return fill


def _number_step(
    source: CounterSource | RampSource | SineSource, cycle_us: int, store: Callable[[float], None]
) -> Callable[[int], None]:
    # One function for each step and no function within it: a plant has hundreds of such variables.
    if isinstance(source, CounterSource):
        step = source.step
        return lambda tick: store(float(tick * step))
    period = _cycles(source.period_ms, cycle_us)
    if isinstance(source, RampSource):
        low, span = float(source.low), source.high - source.low
        return lambda tick: store(low + span * (tick % period) / period)
    turn, offset, amplitude, sine = 2 * math.pi / period, source.offset, source.amplitude, math.sin
    # The remainder keeps the argument small: the sine of a large float has lost its precision.
    return lambda tick: store(offset + amplitude * sine(turn * (tick % period)))
