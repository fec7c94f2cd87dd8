"""What the variables of a subscription hold once its data is too old."""

from __future__ import annotations

from eap.codec.pd import PdHeader
from eap.pd.image import Image, default_value
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
    scratch = Image(memoryview(bytearray(image.layout.size)), image.layout)
    for name in place.variables:
        scratch.write(name, default_value(scratch.places[name]))
    start = place.offset + PdHeader.SIZE
    return bytes(scratch.memory[start : start + place.size])
