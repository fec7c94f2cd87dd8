"""Quality: the age of received data, also where it is sent on.

A frame carries the age of its data in each PD header.  Fresh data has 0; a station that sends
received data on adds the time that the data has been with it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import TypeAlias

from eap.codec.datatypes import variable_of
from eap.codec.pd import PdHeader
from eap.pd.image import Image
from eap.pd.layout import FieldSlot, ImageLayout, RxSlot
from eap.pd.spec import LinkSpec
from eap.pd.words import RxWord, StationWord

QUALITY_NS = 100_000
"""Unit of the quality."""
QUALITY_MAX = 0xFFFF
"""Largest quality: the data is older, or never came."""

Origin: TypeAlias = RxSlot | FieldSlot
"""Subscription, or source in a controller."""
Origins: TypeAlias = Mapping[str, tuple[Origin, ...]]
"""Origins from which variables get their values, by the name of the variable."""

NO_ORIGINS: Origins = MappingProxyType({})

_put_u16 = struct.Struct("<H").pack_into
QUALITY_SIZE = 2
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


def field_quality(image: Image, slot: FieldSlot) -> int:
    """Return the age of a controller's value in units of 100 us at the last cycle, saturated."""
    at_ns = image.words[slot.words]
    if not at_ns:
        return QUALITY_MAX
    age_ns = image.words[StationWord.CYCLE_AT_NS] - at_ns
    # Negative: it came after the last cycle.
    return int(min(max(age_ns, 0) // QUALITY_NS, QUALITY_MAX))


def is_late(image: Image, slot: FieldSlot) -> bool:
    """Return whether a controller's value is older than its time-out at the last cycle."""
    at_ns = image.words[slot.words]
    age_ns = image.words[StationWord.CYCLE_AT_NS] - at_ns
    return not at_ns or age_ns > slot.timeout_ms * 1_000_000


class ForwardedQuality:
    """Quality of a sent PD with received values: the age of the oldest of them.

    Args:
        image: The station's process image.
        slots: The origins of the values.
    """

    def __init__(self, image: Image, slots: Sequence[Origin]) -> None:
        self.slots = slots
        self._ages = [
            partial(field_quality, image, slot)
            if isinstance(slot, FieldSlot)
            else partial(quality, image, slot)
            for slot in slots
        ]

    def into(self, buffer: memoryview, offset: int) -> None:
        """Write it to the header of the PD whose data starts at *offset* of *buffer*."""
        # A PD header has one quality for all values of the PD.
        oldest = max(age() for age in self._ages)
        _put_u16(buffer, offset - QUALITY_SIZE, oldest)


def forwarded_quality(
    image: Image, variables: Iterable[str], origins: Origins
) -> ForwardedQuality | None:
    """Return the quality of a PD with *variables*; None if none of them was received."""
    slots = tuple(dict.fromkeys(slot for name in variables for slot in origins.get(name, ())))
    return ForwardedQuality(image, slots) if slots else None


def find_origins(layout: ImageLayout, links: Iterable[LinkSpec]) -> Origins:
    """Return the origins from which each variable gets its value, directly or by links.

    A link follows those that fill its source, so one pass in their order is enough.
    """
    found: dict[str, tuple[Origin, ...]]
    found = {name: (slot,) for slot in layout.rx for name in slot.variables}
    names = {slot.name for slot in layout.variables}
    for each in layout.fields:
        variable = variable_of(each.variable, names)
        found[variable] = (*found.get(variable, ()), each)
    for link in links:
        if came := found.get(variable_of(link.source, names)):
            # Several links may fill one target by bits or members.
            target = variable_of(link.target, names)
            found[target] = tuple(dict.fromkeys((*found.get(target, ()), *came)))
    return found
