"""Process image of a station as ADS symbols, and notifications of them.

Every variable is a symbol: those of EAP, those of slaves, and the control words of frames and PDs.
Clients write those that belong to the application.  A new layout is a new version of the symbols.

Rule 1: the values of variables in one notification are those of one cycle, and so is its time
stamp, however late it is sent: both come from the samples that the engine keeps.
Rule 2: services computes when the next notification is due, and keeps requesting samples as long as
there is any notification; the engine never waits.
Rule 3: if services is delayed for longer than samples are kept, it misses cycles.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic_ns, time_ns
from typing import NamedTuple, TypeAlias

from eap.ads.notifications import NotificationTable
from eap.ads.request import AdsRefusedError
from eap.ads.space import AdsSpace, Source
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.codec import datatypes
from eap.codec.ads import AdsError
from eap.codec.adsnotification import to_filetime
from eap.codec.basetypes import Text
from eap.codec.datatypes import Array
from eap.codec.structures import Structure
from eap.errors import ImageError, TornReadError, WriterConflictError
from eap.ids import Endpoint, NetId
from eap.net.image_file import StationImage
from eap.pd.image import Image, ImageSamples, extract_value
from eap.pd.layout import VariableSlot
from eap.pd.spec import Writer
from eap.pd.words import StationWord

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
    def reading(self, sample: bytes) -> Iterator[None]:
        """Read from *sample*, of one cycle, for the length of a block."""
        self._sample = sample
        try:
            yield
        finally:
            self._sample = None

    def read(self, name: str) -> bytes:
        """Return the bytes of a value; refuse with BUSY while its writer is in the middle."""
        # Values of one notification come from one sample, not from the running image.
        if self._sample is not None:
            return extract_value(self._image.slot(name), self._sample, self._first_bit)
        try:
            return self._image.load(name, attempts=_ATTEMPTS)
        except TornReadError as exc:
            raise AdsRefusedError(AdsError.BUSY, str(exc)) from None

    def write(self, name: str, octets: bytes) -> None:
        """Store a value; raise BUSY while another program writes, VALUE if it is invalid."""
        kind = datatypes.parse(self._image.slot(name).type)
        # Bytes of texts go on as they are, whatever their encoding; so does the memory of a struct,
        # in which other members may have values that are none of their types.
        is_memory = isinstance(kind, Text | Structure | Array)
        value = bytes(octets) if is_memory else kind.decode(octets, 0)
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
        """The newest image at the last refresh."""
        return self._file.image

    def refresh(self) -> SymbolSpace:
        """Switch to the newest image; return its symbols, or raise NOT_READY."""
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
        """Read from the newest symbols."""
        return self.refresh().read(group, offset, length)

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Write to the newest image."""
        self.refresh().write(group, offset, data)

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Return the answer to a lookup of a name."""
        return self.refresh().read_write(group, offset, length, data)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return the source of a value."""
        return self.refresh().watch(group, offset, length)

    def _table(self) -> SymbolTable:
        variables = map(_variable, self.image.layout.variables)
        return SymbolTable(variables, self._file.generation)


def _variable(slot: VariableSlot) -> SymbolVariable:
    unit = f"[{slot.unit}]" if slot.unit else ""
    return SymbolVariable(
        slot.name,
        datatypes.parse(slot.type),
        " ".join(filter(None, (slot.comment, unit))),
        "" if slot.writer is Writer.APPLICATION else f"is written by the {slot.writer}",
    )


Send: TypeAlias = Callable[[Endpoint, bytes], object]
"""Sends a packet to a client, and does not wait for that."""

_POLL_NS = 200_000_000
"""Longest period of the requests for samples."""
_CYCLE_TIME_NS = 200_000
"""Usual delay from the start of a cycle to its end."""
_SHORT_PAUSE_NS = 1_000_000
_MAX_VALUES = 500
"""Values after which others of this process have a turn."""
_ENGINE_PAUSE_NS = 10_000_000
"""Pause before the next look while the engine does not run."""

logger = logging.getLogger(__name__)


class _NotificationSource(NamedTuple):
    table: NotificationTable
    net_id: NetId
    port: int


class NotificationPump:
    """Drives the notifications of all devices of one station.

    Args:
        symbols: The station's variables.
        send: Sends a packet to a client.
    """

    def __init__(self, symbols: StationSymbols, send: Send) -> None:
        self._symbols = symbols
        self._send = send
        self._sources: list[_NotificationSource] = []
        self._wake = asyncio.Event()
        self._samples: ImageSamples | None = None
        self._last_cycle = 0
        """The last cycle that was looked at."""

    def add(self, table: NotificationTable, net_id: NetId, port: int) -> None:
        """Drive *table* too, which is that of the device behind *net_id* and *port*."""
        self._sources.append(_NotificationSource(table, net_id, port))
        table.on_add = self._wake.set

    def remove(self, net_id: NetId) -> None:
        """Drive no tables of devices behind *net_id* any more."""
        self._sources = [each for each in self._sources if each.net_id != net_id]

    async def serve(self) -> None:
        """Send notifications until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                delay_ns = self.advance(monotonic_ns(), time_ns())
            except Exception:
                logger.exception("notifications of station %s", self._symbols.image.layout.station)
                delay_ns = _POLL_NS
            timer = None
            if delay_ns is not None:
                timer = loop.call_later(delay_ns / 1e9, self._wake.set)
            await self._wake.wait()
            self._wake.clear()
            if timer is not None:
                timer.cancel()

    def advance(self, now_ns: int, unix_ns: int) -> int | None:
        """Send due notifications; return the delay of the next call in nanoseconds, None for none.

        Args:
            now_ns: The time on the monotonic clock.
            unix_ns: The same moment since 1970.
        """
        if self._due_ns() is None:
            self._samples = None
            return None
        try:
            self._symbols.refresh()
        except AdsRefusedError as exc:
            logger.debug("notifications delayed: %s", exc)
            # There is no image just now, as while a new one is made: it is looked for again soon.
            return _POLL_NS
        image = self._symbols.image
        if self._samples is None:
            self._last_cycle = image.words[StationWord.CYCLE]
        if self._samples is None or self._samples.image is not image:
            self._samples = ImageSamples(image)
        is_done = self._send_due(self._samples, unix_ns - now_ns)
        # The engine samples only on request, so an idle station pays nothing.
        self._samples.extend()
        return self._delay_ns(now_ns) if is_done else _SHORT_PAUSE_NS

    def _send_due(self, samples: ImageSamples, unix_at_0_ns: int) -> bool:
        """Send the notifications of cycles since the last call; return False if some are left."""
        budget = _MAX_VALUES
        for cycle in samples.since(self._last_cycle):
            if budget <= 0:
                return False
            self._last_cycle = cycle
            at_ns, due_ns = samples.ran_at_ns(cycle), self._due_ns()
            if due_ns is None:
                return True
            if at_ns is None or at_ns < due_ns:
                continue
            sample = samples.read(cycle)
            if sample is not None:
                with self._symbols.store.reading(sample):
                    budget -= self._send_cycle(at_ns, to_filetime(at_ns + unix_at_0_ns))
        return True

    def _send_cycle(self, at_ns: int, time: int) -> int:
        """Send the notifications of one cycle; return the number of values compared, at most."""
        compared = 0
        for table, net_id, port in self._sources:
            due_ns = table.next_timeout()
            if due_ns is not None and due_ns <= at_ns:
                compared += len(table)
                for notice in table.handle_cycle(at_ns, time):
                    self._send(notice.client.endpoint, notice.encode(net_id, port))
        return compared

    def _due_ns(self) -> int | None:
        times = (each.table.next_timeout() for each in self._sources)
        return min((each for each in times if each is not None), default=None)

    def _delay_ns(self, now_ns: int) -> int | None:
        """Return the delay until the end of the next cycle with a due notification."""
        due_ns = self._due_ns()
        if due_ns is None:
            return 0  # the last one ended just now: look once more, to rest then
        image = self._symbols.image
        cycle_ns = 1000 * image.layout.cycle_us
        ran_ns = image.words[StationWord.CYCLE_AT_NS]
        cycles = max(1, -(-(due_ns - ran_ns) // cycle_ns))
        delay_ns = ran_ns + cycles * cycle_ns + _CYCLE_TIME_NS - now_ns
        soon_ns = _SHORT_PAUSE_NS if delay_ns > -cycle_ns - _ENGINE_PAUSE_NS else _ENGINE_PAUSE_NS
        return min(max(delay_ns, soon_ns), _POLL_NS)
