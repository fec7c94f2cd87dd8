"""Quality: the age of received data, also where it is sent on.

A frame carries the age of its data in each PD header.  Fresh data has 0; a station that sends
received data on adds the time that the data has been with it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

from eap.codec.pd import PdHeader
from eap.codec.structures import variable_of
from eap.pd.image import Image
from eap.pd.layout import ImageLayout, RxSlot
from eap.pd.spec import LinkSpec
from eap.pd.words import RxWord, StationWord

QUALITY_NS = 100_000
"""Unit of the quality."""
QUALITY_MAX = 0xFFFF
"""Largest quality: the data is older, or never came."""

Origins: TypeAlias = Mapping[str, tuple[RxSlot, ...]]
"""Subscriptions from which variables get their values, by the name of the variable."""

NO_ORIGINS: Origins = MappingProxyType({})

_put_u16 = struct.Struct("<H").pack_into
_QUALITY_SIZE = 2
"""The quality is the last field of a PD header."""


def tracker_word(image: Image, slot: RxSlot) -> int:
    """Return the index of the first word of the block that holds a subscription's tracker."""
    # PDs that have always arrived together share the tracker of one of them.
    return int(image.words[slot.words + RxWord.TRACKER]) or slot.words


def quality(image: Image, slot: RxSlot) -> int:
    """Return the age of a subscription's data in units of 100 us, saturated at 65535.

    It is the Quality that the frame carried plus the receiver's own cycles since, and with polled
    data the time from the request to the answer; the rest of a unit is carried from cycle
    to cycle.  Data that never came has the largest.
    """
    words = image.words
    first = tracker_word(image, slot)
    if not words[first + RxWord.RECEIVED]:
        return QUALITY_MAX
    cycles = words[StationWord.CYCLE] - words[first + RxWord.ARRIVED_IN_CYCLE]
    own_ns = max(cycles, 0) * image.layout.cycle_us * 1000 + words[slot.words + RxWord.RESPONSE_NS]
    # Derived when it is read: counting it up in each cycle would cost the cycle for each PD.
    sent = PdHeader.decode(image.memory, slot.offset).quality
    return int(min(sent + own_ns // QUALITY_NS, QUALITY_MAX))


class ForwardedQuality:
    """Quality of a sent PD with received values: the age of the oldest of them.

    Args:
        image: The station's process image.
        slots: The subscriptions that the values come from.
    """

    def __init__(self, image: Image, slots: Sequence[RxSlot]) -> None:
        self._image = image
        self._slots = slots

    def into(self, buffer: memoryview, offset: int) -> None:
        """Write it to the header of the PD whose data starts at *offset* of *buffer*."""
        # A PD header has one quality for all values of the PD.
        oldest = max(quality(self._image, slot) for slot in self._slots)
        _put_u16(buffer, offset - _QUALITY_SIZE, oldest)


def forwarded_quality(
    image: Image, variables: Iterable[str], origins: Origins
) -> ForwardedQuality | None:
    """Return the quality of a PD with *variables*; None if none of them was received."""
    slots = tuple(dict.fromkeys(slot for name in variables for slot in origins.get(name, ())))
    return ForwardedQuality(image, slots) if slots else None


def find_origins(layout: ImageLayout, links: Iterable[LinkSpec]) -> Origins:
    """Return the subscriptions from which each variable gets its value, directly or by links.

    A link follows those that fill its source, so one pass in their order is enough.
    """
    found = {name: (slot,) for slot in layout.rx for name in slot.variables}
    names = {slot.name for slot in layout.variables}
    for link in links:
        if came := found.get(variable_of(link.source, names)):
            # Several links may fill one target by bits or members.
            target = variable_of(link.target, names)
            found[target] = tuple(dict.fromkeys((*found.get(target, ()), *came)))
    return found
