"""The variables of a running station as ADS symbols, in its process image.

Every variable is one: those of EAP, those of slaves, and the control words of frames and PDs.
Clients write those that belong to the application.  A new layout is a new version of the symbols.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from eap.ads.operation import AdsRefusedError
from eap.ads.space import AdsSpace, Source
from eap.ads.symbols import SymbolSpace, SymbolTable, Variable
from eap.codec import datatypes
from eap.codec.ads import AdsError
from eap.codec.values import String
from eap.errors import ImageError, TornReadError, WriterConflictError
from eap.pd.image import Image, take
from eap.pd.layout import VariableSlot
from eap.pd.spec import Writer
from eap.runtime.station_image import StationImage

_ATTEMPTS = 10
"""At a consistent copy, a tenth of a millisecond apart: a client may ask again, others wait."""


class ImageVariables:
    """The values in one image; fits VariableStore by its shape.

    Args:
        station: Whose image it is.
        image: Of one layout.
    """

    def __init__(self, station: StationImage, image: Image) -> None:
        self._sample: bytes | None = None
        self._station = station
        self._image = image
        self._first_bit = 8 * image.layout.samples.first

    @contextmanager
    def shown(self, sample: bytes) -> Iterator[None]:
        """Read from *sample*, of one cycle, for the length of a block."""
        self._sample = sample
        try:
            yield
        finally:
            self._sample = None

    def read(self, name: str) -> bytes:
        """Return the octets of a value; refuse with BUSY while its writer is in the middle."""
        if self._sample is not None:
            return take(self._image.slots[name], self._sample, self._first_bit)
        try:
            return self._image.load(name, attempts=_ATTEMPTS)
        except TornReadError as exc:
            raise AdsRefusedError(AdsError.BUSY, str(exc)) from None

    def write(self, name: str, octets: bytes) -> None:
        """Store a value; refuse with BUSY while another program writes, with VALUE what is none."""
        kind = datatypes.parse(self._image.slots[name].type)
        # A text of a client with another encoding than ours: its octets go on as they are.
        value = bytes(octets) if isinstance(kind, String) else kind.decode(octets, 0)
        try:
            self._station.write_once(Writer.APPLICATION, {name: value})
        except WriterConflictError as exc:
            raise AdsRefusedError(AdsError.BUSY, str(exc)) from None
        except ValueError as exc:
            raise AdsRefusedError(AdsError.VALUE, f"{name}: {exc}") from None
        except ImageError as exc:  # it got a new layout just now
            raise AdsRefusedError(AdsError.SYMBOL_VERSION, str(exc)) from None


class StationSymbols(AdsSpace):
    """The symbols of one station, as its newest image has them.

    Attributes:
        store: The values in :attr:`image`.
    """

    groups = SymbolSpace.groups

    def __init__(self, station: StationImage) -> None:
        self._station = station
        self._file = station.file
        self.store = ImageVariables(station, self.image)
        self._space = SymbolSpace(self._table(), self.store)

    @property
    def image(self) -> Image:
        """The image that was the newest when somebody looked last."""
        return self._file.image

    def look(self) -> SymbolSpace:
        """Go over to the newest image; return the symbols there, or refuse with NOT_READY."""
        try:
            file = self._station.file
        except ImageError as exc:
            raise AdsRefusedError(AdsError.NOT_READY, str(exc)) from None
        if file is not self._file:
            self._file = file
            self.store = ImageVariables(self._station, self.image)
            self._space.replace(self._table(), self.store)
        return self._space

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return what the newest symbols say."""
        return self.look().read(group, offset, length)

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Write to the newest image."""
        self.look().write(group, offset, data)

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Return what belongs to a name."""
        return self.look().read_write(group, offset, length, data)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return what gives a value."""
        return self.look().watch(group, offset, length)

    def _table(self) -> SymbolTable:
        variables = map(_variable, self.image.layout.variables)
        return SymbolTable(variables, self._file.generation)


def _variable(place: VariableSlot) -> Variable:
    unit = f"[{place.unit}]" if place.unit else ""
    return Variable(
        place.name,
        datatypes.parse(place.type),
        " ".join(filter(None, (place.comment, unit))),
        "" if place.writer is Writer.APPLICATION else f"is written by the {place.writer}",
    )
