"""Live entries of a station's dictionaries, from its process image.

This module stores nothing: a read looks the value up in the newest image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.errors import ImageError
from eap.net.image_file import StationImage
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000_keys import EapLive
from eap.pd.image import Image
from eap.pd.layout import (
    FRAME_CTRL,
    VAR_CTRL,
    FrameSlot,
    ImageLayout,
    RxSlot,
    TxSlot,
)
from eap.pd.quality import quality, tracker_word
from eap.pd.report import frame_state, tx_status, tx_var_state, var_state
from eap.pd.words import (
    PD_DROP_INDEX,
    REASON_INDEX,
    FrameWord,
    PdDropReason,
    Reason,
    RxWord,
    StationWord,
    TxWord,
)

_KINDS: dict[str, DataType] = {
    row.live: datatypes.parse(row.kind)
    for each in profile.ALL
    for row in each.entries
    if row.live and row.kind
}
"""Types of the live entries, without those that hold a variable's value."""


class ImageValues:
    """Live values for the dictionaries of one station."""

    def __init__(self, station: StationImage) -> None:
        self._station = station
        self._cached: _Slots | None = None
        self._moment: Image | None = None

    def octets(self, key: str, name: str) -> bytes | None:
        """Return the value of *key* of the object called *name*, None if that does not run."""
        try:
            image = self._station.image
            if key == EapLive.VALUE:
                return _value(image, name)
            # What programs write has no place in a snapshot: it may be cut in two there.
            source = image if key in _CONTROLS else self._moment or image
            number = self._slots(source.layout).number(source, key, name)
        except ImageError:
            return None
        return None if number is None else _encode(_KINDS[key], number)

    @contextmanager
    def consistent_values(self) -> Iterator[None]:
        """Show counters of one moment between two cycles for the length of a block."""
        with suppress(ImageError):
            self._moment = self._station.image.snapshot()
        try:
            yield
        finally:
            self._moment = None

    def _slots(self, layout: ImageLayout) -> _Slots:
        if self._cached is None or self._cached.layout is not layout:
            self._cached = _Slots(layout)
        return self._cached


class _Slots:
    """Places in images of one layout, by name."""

    def __init__(self, layout: ImageLayout) -> None:
        self.layout = layout
        self._frames = {slot.name: slot for slot in layout.frames}
        self._tx = {slot.name: slot for slot in layout.tx}
        self._rx = {slot.name: slot for slot in layout.rx}

    def number(self, image: Image, key: str, name: str) -> int | None:
        if key in _OF_STATION:
            return int(image.words[_OF_STATION[key]])
        if key in _OF_FRAME:
            return _applied(_OF_FRAME[key], image, self._frames.get(name))
        if key in _OF_TX:
            return _applied(_OF_TX[key], image, self._tx.get(name))
        if key in _OF_RX:
            return _applied(_OF_RX[key], image, self._rx.get(name))
        return None


def _applied(function: Callable[[Image, Any], int], image: Image, slot: Any) -> int | None:
    return None if slot is None else function(image, slot)


def _value(image: Image, name: str) -> bytes | None:
    if name not in image.slots:
        return None
    # The bytes as they are: a peer may have sent what no value of the type encodes to.
    octets = image.load(name)
    is_text = datatypes.parse(image.slots[name].type).is_text
    return octets.partition(b"\0")[0].ljust(len(octets), b"\0") if is_text else octets


def _encode(kind: DataType, number: int) -> bytes:
    """Return *number* as near as *kind* can hold it."""
    limits = kind.scalar_range
    if limits is not None:
        # Counters of the image have 64 bits, entries of the profile fewer: they stay at the limit.
        number = int(min(max(number, limits[0]), limits[1]))
    return kind.encode(number)


def _frame_word(word: FrameWord) -> Callable[[Image, FrameSlot], int]:
    return lambda image, slot: int(image.words[slot.words + word])


def _tx_word(word: TxWord) -> Callable[[Image, TxSlot], int]:
    return lambda image, slot: int(image.words[slot.words + word])


def _sent(reason: Reason) -> Callable[[Image, TxSlot], int]:
    return lambda image, slot: int(tx_status(image, slot)["reason"].get(reason.value, 0))


def _last_reason(image: Image, slot: TxSlot) -> int:
    last = tx_status(image, slot)["last_reason"]
    return 0 if last is None else REASON_INDEX[Reason(last)]


def _control(suffix: str) -> Callable[[Image, FrameSlot | TxSlot], int]:
    return lambda image, slot: int(image.read(slot.name + suffix))


def _tracked(word: RxWord) -> Callable[[Image, RxSlot], int]:
    return lambda image, slot: int(image.words[tracker_word(image, slot) + word])


def _discarded(reason: PdDropReason) -> Callable[[Image, RxSlot], int]:
    offset = RxWord.DISCARDED + PD_DROP_INDEX[reason]
    return lambda image, slot: int(image.words[slot.words + offset])


def _cycle_index(image: Image, slot: RxSlot) -> int:
    last = _tracked(RxWord.LAST_CYCLE)(image, slot)
    return last & 0xFFFF if _tracked(RxWord.RECEIVED)(image, slot) else 0


_CONTROLS = frozenset((EapLive.FRAME_CTRL, EapLive.TX_VAR_CTRL))
_OF_STATION: dict[str, int] = {
    EapLive.STATION_CYCLE: StationWord.CYCLE,
    EapLive.STATION_OVERRUNS: StationWord.OVERRUNS,
    EapLive.STATION_RESTARTS: StationWord.RESTARTS,
    EapLive.STATION_TORN: StationWord.TORN,
    EapLive.STATION_LATENESS_MAX: StationWord.LATENESS_MAX_NS,
    EapLive.STATION_LINKS_HELD: StationWord.LINKS_HELD,
} | {
    key: StationWord.DISCARDED + PD_DROP_INDEX[reason]
    for reason in PdDropReason
    if (key := f"station_discarded_{reason}") in _KINDS
}
_OF_FRAME: dict[str, Callable[[Image, FrameSlot], int]] = {
    EapLive.FRAME_STATE: lambda image, slot: frame_state(image, slot.words),
    EapLive.FRAME_CTRL: _control(FRAME_CTRL),
    EapLive.FRAME_WHOLE: _frame_word(FrameWord.WHOLE),
    EapLive.FRAME_PARTIAL: _frame_word(FrameWord.PARTIAL),
    EapLive.FRAME_SKIPPED: _frame_word(FrameWord.SKIPPED),
}
_OF_TX: dict[str, Callable[[Image, TxSlot], int]] = {
    EapLive.TX_VAR_STATE: lambda image, slot: tx_var_state(image.words, slot),
    EapLive.TX_VAR_CTRL: _control(VAR_CTRL),
    EapLive.TX_LAST_REASON: _last_reason,
    EapLive.TX_SKIPPED: _tx_word(TxWord.SKIPPED),
} | {key: _sent(reason) for reason in Reason if (key := f"tx_sent_{reason}") in _KINDS}
_OF_RX: dict[str, Callable[[Image, RxSlot], int]] = {
    EapLive.RX_QUALITY: quality,
    EapLive.RX_CYCLE_INDEX: _cycle_index,
    EapLive.RX_VAR_STATE: var_state,
    EapLive.RX_STATE: _tracked(RxWord.STATE),
    EapLive.RX_RECEIVED: _tracked(RxWord.RECEIVED),
    EapLive.RX_LOST: _tracked(RxWord.LOST),
    EapLive.RX_DUPLICATED: _tracked(RxWord.DUPLICATED),
    EapLive.RX_REORDERED: _tracked(RxWord.REORDERED),
    EapLive.RX_LATE: _tracked(RxWord.LATE),
    EapLive.RX_TIMEOUTS: _tracked(RxWord.TIMEOUTS),
    EapLive.RX_REPEATED: _tracked(RxWord.REPEATED),
    EapLive.RX_JITTER_MAX: _tracked(RxWord.JITTER_MAX_US),
} | {
    key: _discarded(reason)
    for reason in PdDropReason
    if (key := f"rx_discarded_{reason}") in _KINDS
}
