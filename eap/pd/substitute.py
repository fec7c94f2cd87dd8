"""What the variables of a subscription hold once its data is too old."""

from __future__ import annotations

from eap.codec import datatypes
from eap.codec.pd import PdHeader
from eap.pd.image import Image, default_value, put
from eap.pd.layout import RxPlace
from eap.pd.spec import Substitute


class SubstituteValue:
    """The octets that replace a PD's data after its time-out; with HOLD there are none."""

    def __init__(self, image: Image, place: RxPlace) -> None:
        start = place.offset + PdHeader.SIZE
        self._memory = image.memory
        self._data = slice(start, start + place.size)
        self._octets = _octets(image, place)

    def apply(self) -> None:
        """Put the substitute in the place of the data."""
        if self._octets is not None:
            self._memory[self._data] = self._octets


def _octets(image: Image, place: RxPlace) -> bytes | None:
    if place.substitute is Substitute.HOLD:
        return None
    if place.substitute is Substitute.ZERO:
        return bytes(place.size)
    octets = memoryview(bytearray(place.size))
    start = 8 * (place.offset + PdHeader.SIZE)
    for name in place.variables:
        variable = image.places[name]
        kind = datatypes.parse(variable.type)
        value = kind.encode(default_value(variable))
        put(octets, variable.bit_offset - start, kind.bit_length, value)
    return bytes(octets)
