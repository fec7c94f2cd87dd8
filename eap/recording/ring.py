"""The last minutes of a recording in memory, and the times of which they are kept, without I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum, auto

from eap.recording.capture import CapturedBlock

RING_BYTES = 256 << 20
"""Memory of a ring; a longer one has its newest part only."""
_COMPRESS_FROM = 2048


class BlockRing:
    """The blocks of the last *length_ns*, compressed.

    Args:
        length_ns: Time to keep.
        compress: Makes bytes shorter.
        decompress: The reverse.
        limit: Bytes at most.

    Attributes:
        size: Bytes in memory.
        is_cut: Whether blocks younger than *length_ns* had to be dropped.
    """

    def __init__(
        self,
        length_ns: int,
        compress: Callable[[bytes], bytes],
        decompress: Callable[[bytes], bytes],
        limit: int = RING_BYTES,
    ) -> None:
        self._length_ns = length_ns
        self._compress = compress
        self._decompress = decompress
        self._limit = limit
        self._blocks: deque[tuple[CapturedBlock, bool]] = deque()
        self.size = 0
        self.is_cut = False

    def add(self, block: CapturedBlock) -> None:
        """Keep *block*, and drop what is too old or too much."""
        # Short blocks do not become shorter.
        packed = len(block.data) >= _COMPRESS_FROM
        if packed:
            block = block._replace(data=self._compress(block.data))
        self._blocks.append((block, packed))
        self.size += len(block.data)
        while self._blocks[0][0].last_ns < block.last_ns - self._length_ns:
            self._drop()
        # The newest block stays in any case.
        while self.size > self._limit and len(self._blocks) > 1:
            self._drop()
            self.is_cut = True

    def since(self, time_ns: int) -> Iterator[CapturedBlock]:
        """Yield the blocks with something at or after *time_ns* in Unix time, the oldest first."""
        for block, packed in self._blocks:
            if block.last_ns >= time_ns:
                yield block._replace(data=self._decompress(block.data)) if packed else block

    @property
    def held_ns(self) -> int:
        """Time between the first and the last of what is kept."""
        if not self._blocks:
            return 0
        return self._blocks[-1][0].last_ns - self._blocks[0][0].first_ns

    def clear(self) -> None:
        """Drop all."""
        self._blocks.clear()
        self.size = 0

    def _drop(self) -> None:
        block, _ = self._blocks.popleft()
        self.size -= len(block.data)


class TriggerAction(Enum):
    """Action of a recorder for a trigger."""

    OPEN = auto()
    """Begin a file with what the ring has from *before_ns* on."""
    MARK = auto()
    """The condition became true once more: the file goes on for longer."""
    CLOSE = auto()
    """The time after the last trigger is over."""


class RecordingTrigger:
    """Times to record around the moments in which a condition becomes true.

    Args:
        before_ns: Time to record before such a moment.
        after_ns: Time to record behind it.
    """

    def __init__(self, before_ns: int, after_ns: int) -> None:
        self.before_ns = before_ns
        self._after_ns = after_ns
        self._was_true = False
        self._until_ns: int | None = None
        self.count = 0
        """Number of such moments."""

    @property
    def is_recording(self) -> bool:
        """True from OPEN to CLOSE."""
        return self._until_ns is not None

    def reset(self) -> None:
        """Forget the condition and what is to be recorded: the plant has gone."""
        self._was_true = False
        self._until_ns = None

    def update(self, time_ns: int, *, is_true: bool) -> TriggerAction | None:
        """Take the condition at *time_ns*; return the action for a change to true."""
        rises = is_true and not self._was_true
        self._was_true = is_true
        if not rises:
            return None
        action = TriggerAction.MARK if self.is_recording else TriggerAction.OPEN
        self._until_ns = time_ns + self._after_ns
        self.count += 1
        return action

    def handle_time(self, time_ns: int) -> TriggerAction | None:
        """Return CLOSE when all up to *time_ns* was recorded and that is enough."""
        if self._until_ns is None or time_ns <= self._until_ns:
            return None
        self._until_ns = None
        return TriggerAction.CLOSE
