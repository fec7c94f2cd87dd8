"""Sequence trackers: lost, late and reordered frames, by cycle counters and arrival times.

Rule 1: PDs that have always arrived together share one tracker; they part when they first arrive
apart.  All members of a tracker have the same history, so the copy that starts the new tracker
is exact, and a frame of a hundred PDs costs one tracker, not a hundred.
Rule 2: an older counter is a reordered frame and not taken, since newer data is here already; what
was counted as lost because of it is not lost any more.  The third in a row that fills no gap is a
sender that restarted its counter, and is taken.
Rule 3: the same counter again counts as duplicated and is taken: some terminals never count.  With
another toggle bit it is a new frame all the same; with the same one, from a sender that was seen to
toggle, it also counts as repeated.  A toggle bit alone proves nothing: behind a lost frame it is
that of the frame before, and a sender that toggles over several frames shows each receiver some.
"""

from __future__ import annotations

import struct

from eap.pd.words import BIN_OF_US, TRACKER_START, RxState, RxWord, histogram_bin

_RECEIVED = RxWord.RECEIVED - TRACKER_START
_DUPLICATED = RxWord.DUPLICATED - TRACKER_START
_REORDERED = RxWord.REORDERED - TRACKER_START
_LATE = RxWord.LATE - TRACKER_START
_TIMEOUTS = RxWord.TIMEOUTS - TRACKER_START
_REPEATED = RxWord.REPEATED - TRACKER_START
_LOST = RxWord.LOST - TRACKER_START
_STATE = RxWord.STATE - TRACKER_START
_LAST_CYCLE = RxWord.LAST_CYCLE - TRACKER_START
_ARRIVED_AT_NS = RxWord.ARRIVED_AT_NS - TRACKER_START
_ARRIVED_IN_CYCLE = RxWord.ARRIVED_IN_CYCLE - TRACKER_START
_BEHIND = RxWord.BEHIND - TRACKER_START
_HOLES = RxWord.HOLES - TRACKER_START
_HOLES_BELOW = RxWord.HOLES_BELOW - TRACKER_START
_SENDER = RxWord.SENDER - TRACKER_START
_JITTER_MAX_US = RxWord.JITTER_MAX_US - TRACKER_START
_JITTER = RxWord.JITTER - TRACKER_START

_RUNNING = int(RxState.RUNNING)
# Words that lie side by side are read in one call: each access to a memoryview costs 20 ns.  They
# are written one by one all the same: pack_into would show readers a 0 in between.
_read_last = struct.Struct("2q").unpack_from  # LAST_CYCLE, ARRIVED_AT_NS
_LAST_OFFSET = 8 * _LAST_CYCLE
_BINS_KNOWN = len(BIN_OF_US)
_NEAR = 0x3FFF
"""Counter steps that can only mean what they say, unless a long time has passed."""
REORDER_WINDOW = 32
"""Sender steps by which a frame can be out of order; further back the sender has restarted."""
RESTARTED_AFTER = 3
"""Older counters in a row that mean the same."""


class Timing:
    """Timing of the sender, and the receiver's own cycle; 0 where unknown.

    Attributes:
        step: Sender cycles between two frames, 0 when it sends on change or event.
        sender_cycle_ns: The sender's device cycle.
        own_cycle_ns: The receiver's device cycle.
        polled: Whether it answers requests, so that it has no rhythm to deviate from.
    """

    __slots__ = ("own_cycle_ns", "polled", "sender_cycle_ns", "step")

    def __init__(
        self, *, step: int, sender_cycle_ns: int, own_cycle_ns: int, polled: bool = False
    ) -> None:
        self.step = step
        self.sender_cycle_ns = sender_cycle_ns
        self.own_cycle_ns = own_cycle_ns
        self.polled = polled


class SequenceTracker:
    """The tracker in the block of words that starts at *first_word*."""

    __slots__ = (
        "_own_cycle_ns",
        "_sender_cycle_ns",
        "_step",
        "_timing",
        "_toggle",
        "_toggle_cycle",
        "_toggles",
        "_usual_gap",
        "_usual_ns",
        "_words",
        "_wrap_ns",
        "first_word",
    )

    def __init__(self, words: memoryview, first_word: int, timing: Timing) -> None:
        self.first_word = first_word
        self._timing = timing
        self._step = timing.step
        self._sender_cycle_ns = timing.sender_cycle_ns
        self._own_cycle_ns = timing.own_cycle_ns
        # What a sender of known step and cycle does nearly always.
        self._usual_ns = timing.step * timing.sender_cycle_ns
        known = self._usual_ns > 0 and timing.step <= _NEAR
        self._usual_gap = timing.step if known else -1
        # A quarter of the 16 bits: within that time a step of the counter has one meaning only.
        self._wrap_ns = timing.sender_cycle_ns << 14 or 1 << 62
        self._words = words[first_word + TRACKER_START : first_word + RxWord.SIZE]
        self._toggle = self._toggle_cycle = -1
        self._toggles = False
        if not self._words[_RECEIVED]:
            self.forget_sender()

    @property
    def is_running(self) -> bool:
        """True if the subscriptions of this tracker are in state RUNNING."""
        return bool(self._words[_STATE] == _RUNNING)

    @property
    def timing_numbers(self) -> tuple[int, ...]:
        """Its first word and the numbers that :meth:`arrived` computes with; for compiled plans."""
        return (
            self.first_word + TRACKER_START,
            self._usual_gap,
            self._usual_ns,
            self._wrap_ns,
            self._step,
            0 if self._timing.polled else self._sender_cycle_ns,
            self._own_cycle_ns,
        )

    @property
    def arrived_at_ns(self) -> int:
        """Arrival of the last frame taken."""
        return int(self._words[_ARRIVED_AT_NS])

    def has_taken(self, cycle: int) -> bool:
        """Return whether the frame entered last, with this cycle counter, was taken."""
        return bool(self._words[_LAST_CYCLE] & 0xFFFF == cycle)

    def enter_response(self, response_ns: int) -> None:
        """Enter how long an answer took: in place of jitter, and as late after the next cycle."""
        words = self._words
        if self._sender_cycle_ns and response_ns > self._sender_cycle_ns + self._own_cycle_ns:
            words[_LATE] += 1
        micros = response_ns // 1000
        words[_JITTER + histogram_bin(micros)] += 1
        words[_JITTER_MAX_US] = max(words[_JITTER_MAX_US], micros)

    def forget_sender(self) -> None:
        """Treat the next frame as the first of a sender, which is compared with nothing."""
        self._words[_LAST_CYCLE] = -1
        self._words[_HOLES] = 0

    def pause(self) -> None:
        """Nothing is taken for a while: what does not come meanwhile is neither late nor lost."""
        self.forget_sender()
        self._words[_STATE] = RxState.WAITING

    def follow(self, publisher: int) -> None:
        """Note the publisher of the next frame: another publisher has another counter."""
        if self._words[_SENDER] != publisher:
            self._words[_SENDER] = publisher
            self.forget_sender()

    def time_out(self) -> None:
        """Enter that the sender went quiet."""
        self._words[_STATE] = RxState.STALE
        self._words[_TIMEOUTS] += 1

    def part(self, words: memoryview, first_word: int) -> SequenceTracker:
        """Start a tracker of the same history in the block at *first_word*."""
        words[first_word + TRACKER_START : first_word + RxWord.SIZE] = self._words
        return SequenceTracker(words, first_word, self._timing)

    def enter_toggle(self, toggle: int, cycle: int) -> None:
        """Note the toggle bit of the frame that was just entered with this cycle counter."""
        if not self.has_taken(cycle):
            return
        is_same = toggle == self._toggle
        if cycle == self._toggle_cycle:
            if not is_same:
                self._words[_DUPLICATED] -= 1  # counted by arrived(), which knows the counter only
            elif self._toggles:
                self._words[_REPEATED] += 1
        self._toggles = self._toggles or (self._toggle >= 0 and not is_same)
        self._toggle, self._toggle_cycle = toggle, cycle

    def arrived(self, cycle: int, at_ns: int, own_cycle: int) -> bool:
        """Enter a frame; return whether its data is to be taken.

        Args:
            cycle: Its cycle counter, 16 bits.
            at_ns: When the kernel received it.
            own_cycle: The own cycle whose input image it refreshes.
        """
        words = self._words
        last, last_at_ns = _read_last(words, _LAST_OFFSET)
        position = cycle
        if last >= 0:
            elapsed_ns = at_ns - last_at_ns
            gap = cycle - last & 0xFFFF
            # The usual case first, with two comparisons: this runs for each frame.
            if gap == self._usual_gap and elapsed_ns <= self._wrap_ns:
                self._enter_jitter(elapsed_ns - self._usual_ns)
            else:
                if gap > _NEAR or elapsed_ns > self._wrap_ns:
                    gap = self._resolve(gap, elapsed_ns)
                if not self._enter_gap(gap, last, elapsed_ns):
                    return False
            # Unwrapped, so that holes are told from those of long ago.
            position = last + gap if gap >= 0 else cycle
        words[_RECEIVED] += 1
        words[_STATE] = _RUNNING
        words[_LAST_CYCLE] = position
        words[_ARRIVED_AT_NS] = at_ns
        words[_ARRIVED_IN_CYCLE] = own_cycle
        words[_BEHIND] = 0
        return True

    def _enter_gap(self, gap: int, last: int, elapsed_ns: int) -> bool:
        """Enter a frame that did not come just as expected; return whether it is to be taken."""
        if gap == 0:
            self._words[_DUPLICATED] += 1
        if gap < 0:
            return not self._is_reordered(last + gap, -gap)
        if gap > 0:
            step = self._step
            if step and gap >= 2 * step:
                self._enter_loss(gap // step - 1, last + gap)
            if self._sender_cycle_ns and not self._timing.polled:
                self._enter_jitter(elapsed_ns - gap * self._sender_cycle_ns)
        return True

    def _resolve(self, gap: int, elapsed_ns: int) -> int:
        """Of all gaps that the wrapped counter can mean, return the one nearest to the time."""
        if not self._sender_cycle_ns:
            return gap - 0x10000 if gap > 0x7FFF else gap
        # The counter has 16 bits: after a long silence it may have wrapped any number of times.
        return gap + 0x10000 * round((elapsed_ns / self._sender_cycle_ns - gap) / 0x10000)

    def _enter_loss(self, lost: int, position: int) -> None:
        """Count what did not come before the frame at *position*, and remember the nearest."""
        words = self._words
        words[_LOST] += lost
        holes = words[_HOLES]
        if holes:
            # Bounded: after a long silence the shift would make a number of any size.
            holes <<= min((position - words[_HOLES_BELOW]) // self._step, REORDER_WINDOW)
        holes |= (1 << min(lost, REORDER_WINDOW)) - 1
        words[_HOLES] = holes & (1 << REORDER_WINDOW) - 1
        words[_HOLES_BELOW] = position

    def _fills_hole(self, position: int) -> bool:
        """Return whether the frame at *position* was missed; its PD is not lost then."""
        words = self._words
        steps, rest = divmod(words[_HOLES_BELOW] - position, self._step or 1)
        if rest or not 0 < steps <= REORDER_WINDOW or not words[_HOLES] >> steps - 1 & 1:
            return False
        words[_HOLES] -= 1 << steps - 1
        words[_LOST] -= 1
        return True

    def _is_reordered(self, position: int, behind: int) -> bool:
        words = self._words
        if not self._fills_hole(position):
            words[_BEHIND] += 1
            restarted = behind > REORDER_WINDOW * max(self._step, 1)
            if restarted or words[_BEHIND] >= RESTARTED_AFTER:
                words[_HOLES] = 0
                return False
        words[_REORDERED] += 1
        return True

    def _enter_jitter(self, deviation_ns: int) -> None:
        words = self._words
        if deviation_ns > self._own_cycle_ns:
            words[_LATE] += 1
        micros = abs(deviation_ns) // 1000
        if micros < _BINS_KNOWN:
            words[_JITTER + BIN_OF_US[micros]] += 1
        else:
            words[_JITTER + histogram_bin(micros)] += 1
        if micros > words[_JITTER_MAX_US]:  # noqa: PLR1730  max() takes five times as long
            words[_JITTER_MAX_US] = micros
