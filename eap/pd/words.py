"""Counters of a process image: meaning of its 64-bit words.

One station's image ends in an array of signed 64-bit words.  It starts with the station's own
block, followed by one block for each TxFrame, TxPD and RxPD.  Counters are incremented in place,
there is no second copy: that is why they survive the engine.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag, StrEnum, auto
from itertools import accumulate


class PdDropReason(StrEnum):
    """Reason for which a PD, or a whole frame, was dropped."""

    WRONG_PUBLISHER = auto()
    UNKNOWN_ID = auto()
    VERSION = auto()
    LENGTH = auto()
    SUPPRESSED = auto()
    """The station was not in Op."""
    STALE = auto()
    """It had waited in the socket since before the engine started."""
    TRUNCATED = auto()
    COUNT_TOO_LARGE = auto()
    WRONG_TYPE = auto()
    """The frame is of a type that is not expected here, such as TwinCAT's undocumented 7."""
    TOO_MANY_REQUESTS = auto()
    """The data was taken, but more stations sent requests in one cycle than are answered in one."""
    NO_SENDER = auto()
    """The data was taken, but its frame has no address to answer."""
    WRONG_SOURCE = auto()
    """The frame came from another address than the publisher's."""
    WRONG_LENGTH = auto()
    """The data was taken, but the Length of the frame is not that of its PDs."""
    UNSIGNED = auto()
    """The frame has no signature, and the subscription looks at it."""
    BAD_TAG = auto()
    """The signature is not that of a key of this station."""
    REPLAYED = auto()
    """The counter of the signature has not risen."""


class Reason(StrEnum):
    """Reason for which a PD was sent."""

    CYCLE = auto()
    DIVIDER = auto()
    CHANGE = auto()
    CHANGE_TIMEOUT = auto()
    EVENT = auto()
    POLL = auto()


PD_DROP_REASONS = tuple(PdDropReason)
REASONS = tuple(Reason)
PD_DROP_INDEX = {reason: index for index, reason in enumerate(PD_DROP_REASONS)}
REASON_INDEX = {reason: index for index, reason in enumerate(REASONS)}

HISTOGRAM_BINS = 64


class StationWord(IntEnum):
    """The station's own block."""

    CYCLE = 0
    """Cycle counter, not wrapped; frames carry its low 16 bits.  OVERRUNS completes the time."""
    CYCLE_AT_NS = 1
    """Due time of that cycle on the monotonic clock."""
    FUTEX = 2
    """Low half: the cycle again when it has ended, as the word that waiting programs sleep on."""
    WAITERS = 3
    """The cycle in which a program last went to sleep: waiting programs have to be woken."""
    ENGINE_SEQUENCE = 4
    """Odd while the engine writes its region; likewise the next two."""
    SERVICES_SEQUENCE = 5
    APPLICATION_SEQUENCE = 6
    ENGINE_PID = 7
    """Process that writes each region, or did last."""
    SERVICES_PID = 8
    APPLICATION_PID = 9
    RETIRED = 10
    """1 when a file of a newer generation has taken this one's place."""
    STATE = 11
    """Device state as AL status numbers it: 1 Init, 2 PreOp, 4 SafeOp, 8 Op."""
    STARTED_AT_NS = 12
    """Time at which this engine reached Op, on the monotonic clock."""
    RESTARTS = 13
    OVERRUNS = 14
    """Cycles left out because the engine came too late for them."""
    TORN = 15
    """Cycles in which a writer had stopped in the middle of writing."""
    LATENESS_MAX_NS = 16
    SIGNING_KEY = 17
    """Number of the key that signs its frames; 0 without one."""
    DISCARDED = 18
    LATENESS = DISCARDED + len(PD_DROP_REASONS)
    LINKS_HELD = LATENESS + HISTOGRAM_BINS
    """Values that no link could pass on, because their source was infinite or no number."""
    SAMPLED_UNTIL = LINKS_HELD + 1
    """The last cycle of which a reader wants a sample; written by all readers of samples."""
    BEHIND_NS = LINKS_HELD + 2
    """Usual time from the begin of its group until it runs behind others; 0 if it never did."""
    SIZE = LINKS_HELD + 3


WAKE_FOR_CYCLES = 100
"""Cycles after the last announcement of a waiting program in which waiters are woken."""


class FrameWord(IntEnum):
    """The block of a TxFrame."""

    WHOLE = 0
    """Sent with all its PDs, each due by the same schedule: their own counters are not touched."""
    PARTIAL = 1
    """Sent otherwise."""
    SKIPPED = 2
    """Due, but suppressed or not taken by the network."""
    SENT_AT_NS = 3
    UNSENT_AT_NS = 4
    """Last time that it was due and not sent; current if at or after SENT_AT_NS."""
    UNSENT = 5
    """FrameState of that time."""
    ADDRESS = 6
    """Current destination as a word of ``eap.pd.address``; 0 while that is not known."""
    PRESENCE = 7
    """SubscriberPresence as a number, written by the monitor."""
    SIZE = 8


class FrameState(IntFlag):
    """FrameState of ETG.1005."""

    NOT_SENT = 1
    """Not sent when it was due last."""
    OVERSIZED = 2
    """Because it is larger than its network carries."""
    SUBSCRIBER_MISSING = 4


class TxWord(IntEnum):
    """The block of a TxPD."""

    SKIPPED = 0
    """Due, but suppressed, or its frame was."""
    LAST_REASON = 1
    """Index into REASONS of the last time it was sent on its own."""
    SENT_AT_NS = 2
    UNSENT_AT_NS = 3
    """Last time that it was due and not sent; VarState follows from it (report.py)."""
    REASON = 4
    SIZE = REASON + len(REASONS)


class RxWord(IntEnum):
    """The block of an RxPD: what is its own, then the tracker that it may share.

    PDs that have always arrived together share one tracker; TRACKER is the block that holds it.
    """

    TRACKER = 0
    """Index of the first word of the block that holds the tracker."""
    MISMATCH = 1
    """VarState: bit 0 version, bit 1 length, of the last PD dropped."""
    MISMATCH_AT_NS = 2
    RESPONSE_NS = 3
    """From a request to its answer: of the one that was taken last; 0 without a request."""
    SOURCE = 4
    """Address that the last frame taken came from, as ``eap.pd.address`` puts it; 0 unknown."""
    OTHER_SOURCE = 5
    """Address that takes turns with SOURCE: a second sender with the same publisher ID."""
    OTHER_SOURCE_AT_NS = 6
    WRONG_SOURCE = 7
    """Address of the last frame dropped because it is not the publisher's."""
    WRONG_SOURCE_AT_NS = 8
    SIGNED = 9
    """Counter of the last signature that was accepted; 0 before the first."""
    DISCARDED = 10
    RECEIVED = DISCARDED + len(PD_DROP_REASONS)
    DUPLICATED = RECEIVED + 1
    REORDERED = RECEIVED + 2
    LATE = RECEIVED + 3
    LOST = RECEIVED + 4
    TIMEOUTS = RECEIVED + 5
    REPEATED = RECEIVED + 6
    """Duplicated PDs of a sender that toggles, with the toggle bit of the one before."""
    STATE = RECEIVED + 7
    """RxState as a number."""
    LAST_CYCLE = RECEIVED + 8
    """Cycle counter of the last frame taken (CycleIndex), not wrapped; -1 before the first."""
    ARRIVED_AT_NS = RECEIVED + 9
    ARRIVED_IN_CYCLE = RECEIVED + 10
    """Own cycle whose input image it refreshed; the quality counts from it."""
    BEHIND = RECEIVED + 11
    """Frames in a row that came with an older counter and filled no hole."""
    HOLES = RECEIVED + 12
    """Bit n: of the PDs counted as lost, the one n + 1 steps before HOLES_BELOW may still come."""
    HOLES_BELOW = RECEIVED + 13
    SENDER = RECEIVED + 14
    """With any publisher: the NetID that the tracker follows, as a number."""
    JITTER_MAX_US = RECEIVED + 15
    """This and JITTER: deviation from the sender's rhythm; of answers the time they took."""
    JITTER = RECEIVED + 16
    SIZE = JITTER + HISTOGRAM_BINS


TRACKER_START = RxWord.RECEIVED
"""First word of the tracker within an RxPD's block; it reaches to the end of the block."""


class RxState(IntEnum):
    """State of a subscription."""

    WAITING = 0
    """Nothing received yet."""
    RUNNING = 1
    """Data is younger than the time-out."""
    STALE = 2
    """The publisher went quiet; the substitute applies."""


def histogram_bin(value: int) -> int:
    """Return the bin of *value* (microseconds): four bins to each power of two."""
    if value < 4:
        return max(value, 0)
    exponent = value.bit_length()
    # From 131 ms on everything is in the last bin; the exact maximum has a word of its own.
    if exponent > 17:
        return HISTOGRAM_BINS - 1
    return 4 * (exponent - 2) + (value >> exponent - 3 & 3)


def bin_upper_edge(index: int) -> int:
    """Return the largest value that falls into bin *index*."""
    if index < 4:
        return index
    shift = index // 4 - 1
    return ((index % 4 + 5) << shift) - 1


BIN_OF_US = bytes(histogram_bin(value) for value in range(4096))
"""The bins of the first 4 ms, looked up instead of computed in the cycle."""


def percentile(bins: list[int], share: float) -> int | None:
    """Return the upper edge of the bin below which *share* of all entries lie, None if empty."""
    total = sum(bins)
    if not total:
        return None
    wanted = total * share
    return bin_upper_edge(next(i for i, seen in enumerate(accumulate(bins)) if seen >= wanted))
