"""Keys of entries of the EAP device whose values come from elsewhere than its configuration."""

from __future__ import annotations

from enum import StrEnum, auto


class EapLive(StrEnum):
    """Keys of live entries; the name of the object says of which variable, frame or PD."""

    VALUE = auto()
    """Of the variable, as it lies in the process image."""
    FRAME_STATE = auto()
    FRAME_CTRL = auto()
    FRAME_WHOLE = auto()
    FRAME_PARTIAL = auto()
    FRAME_SKIPPED = auto()
    TX_VAR_STATE = auto()
    TX_VAR_CTRL = auto()
    TX_LAST_REASON = auto()
    TX_SKIPPED = auto()
    TX_SENT_CYCLE = auto()
    TX_SENT_DIVIDER = auto()
    TX_SENT_CHANGE = auto()
    TX_SENT_CHANGE_TIMEOUT = auto()
    TX_SENT_EVENT = auto()
    TX_SENT_POLL = auto()
    RX_QUALITY = auto()
    RX_CYCLE_INDEX = auto()
    RX_VAR_STATE = auto()
    RX_STATE = auto()
    RX_RECEIVED = auto()
    RX_LOST = auto()
    RX_DUPLICATED = auto()
    RX_REORDERED = auto()
    RX_LATE = auto()
    RX_TIMEOUTS = auto()
    RX_REPEATED = auto()
    RX_JITTER_MAX = auto()
    RX_DISCARDED_VERSION = auto()
    RX_DISCARDED_LENGTH = auto()
    RX_DISCARDED_SUPPRESSED = auto()
    RX_DISCARDED_STALE = auto()
    RX_DISCARDED_WRONG_SOURCE = auto()
    RX_DISCARDED_WRONG_LENGTH = auto()
    RX_DISCARDED_UNSIGNED = auto()
    RX_DISCARDED_BAD_TAG = auto()
    RX_DISCARDED_REPLAYED = auto()
    STATION_CYCLE = auto()
    STATION_OVERRUNS = auto()
    STATION_RESTARTS = auto()
    STATION_TORN = auto()
    STATION_LATENESS_MAX = auto()
    STATION_LINKS_HELD = auto()
    STATION_DISCARDED_WRONG_PUBLISHER = auto()
    STATION_DISCARDED_UNKNOWN_ID = auto()
    STATION_DISCARDED_TRUNCATED = auto()
    STATION_DISCARDED_COUNT_TOO_LARGE = auto()
    STATION_DISCARDED_WRONG_TYPE = auto()
    STATION_DISCARDED_TOO_MANY_REQUESTS = auto()
    STATION_DISCARDED_NO_SENDER = auto()
    STATION_DISCARDED_WRONG_LENGTH = auto()


class Derived(StrEnum):
    """Keys of entries that the dictionary computes from others."""

    BIT_LENGTH = auto()
    TYPE_CODE = auto()
    PDO_LENGTH = auto()
    FRAME_LENGTH = auto()
    COUNT = auto()
    """Objects of the kind that the sub-index stands for, see COUNTED."""
    NEXT_FREE = auto()
    """First free index of that kind, 0 if all are taken."""
