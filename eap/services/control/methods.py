"""General methods of the control protocol, answered from the process images.

Rule: what is about images does not wait.  An image is read by copying, a value is written under the
lock that also keeps user programs apart, and the engine notices neither.  Only ``status`` waits a
little, for what the engine says of its buses; what is done on buses is in :mod:`bus_methods`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Mapping
from inspect import isawaitable
from time import monotonic_ns, time_ns
from typing import Any

from msgspec.structs import asdict

from eap.codec import datatypes
from eap.codec.datatypes import variable_of
from eap.control import protocol as control
from eap.control.bus import BUS_METHODS
from eap.control.protocol import VERSION, ErrorCode, of_station, parameters
from eap.errors import ControlError, ImageError, WriterConflictError
from eap.net.image_file import StationImage
from eap.pd.image import Image
from eap.pd.layout import VariableSlot
from eap.pd.quality import field_quality, is_late, quality, tracker_word
from eap.pd.report import PdRow, pd_list
from eap.pd.spec import Writer
from eap.pd.words import RxState, RxWord, StationWord
from eap.suggest import suggest

MIN_PERIOD_MS = 10
_OTHERS = (Writer.SERVICES, Writer.APPLICATION)
"""The writers whose values do not belong to a cycle."""


class Methods:
    """All methods but those with the state of a connection (subscriptions, buses).

    Args:
        identity: What ``hello`` says beside the protocol's version.
        images: The process image of each station.
        status: Makes the answer to ``status``.
        stop: Asks the appliance to end.
        deny_write: Returns the reason that a user of the page or a bridge may not write variables
            of a station, empty if it may.
        more: Other methods by name.
    """

    def __init__(
        self,
        identity: Mapping[str, Any],
        images: Mapping[str, StationImage],
        *,
        status: Callable[[], Awaitable[dict[str, Any]]],
        stop: Callable[[], None],
        deny_write: Callable[[str, control.WriteOrigin], str] = lambda *_: "",
        more: Mapping[str, Callable[[dict[str, Any]], Any]] | None = None,
    ) -> None:
        self._identity = identity
        self._images = images
        self._status = status
        self._stop = stop
        self._deny_write = deny_write
        self._methods: dict[str, Callable[[dict[str, Any]], Any]] = {
            "status": self._get_status,
            **dict(
                (
                    control.HELLO.served_by(self._hello),
                    control.PD_LIST.served_by(self._pd_list),
                    control.VARIABLES.served_by(self._variables),
                    control.READ.served_by(self._read),
                    control.WRITE.served_by(self._write),
                    control.STOP.served_by(self._stop_appliance),
                )
            ),
            **(more or {}),
        }

    async def call(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of one method; raise EapError if it is not done."""
        try:
            function = self._methods[method]
        except KeyError:
            known = [*self._methods, "subscribe", "unsubscribe", *BUS_METHODS]
            raise ControlError(
                f"no method {method!r}{suggest(method, known)}", code=ErrorCode.UNKNOWN_METHOD
            ) from None
        result = function(params)
        return await result if isawaitable(result) else result

    def watch(self, params: dict[str, Any]) -> Watch:
        """Check the parameters of ``subscribe`` and return the source of its events."""
        wanted = parameters(params, control.SubscribeParameters)
        if wanted.period_ms < MIN_PERIOD_MS:
            raise ControlError(
                f"period_ms is {wanted.period_ms}, the shortest is {MIN_PERIOD_MS}: user programs"
                f" that need each cycle attach to the process image",
                code=ErrorCode.BAD_REQUEST,
            )
        station = self._station(wanted.station)
        _slots_of(station.image, wanted.names)
        return Watch(station, wanted.names, wanted.period_ms, only_changes=wanted.on == "change")

    def _hello(self, wanted: control.NoParameters) -> control.Hello:
        del wanted
        return control.Hello(version=VERSION, **self._identity, stations=list(self._images))

    async def _get_status(self, params: dict[str, Any]) -> dict[str, Any]:
        parameters(params, control.NoParameters)
        return await self._status()

    def _pd_list(self, wanted: control.PdListParameters) -> list[PdRow]:
        names = [wanted.station] if wanted.station else list(self._images)
        return [row for name in names for row in pd_list(self._image(name))]

    def _variables(self, wanted: control.VariablesParameters) -> list[control.VariableRow]:
        return [
            control.VariableRow(slot.name, slot.type, slot.writer, slot.unit, slot.comment)
            for slot in self._image(wanted.station).layout.variables
        ]

    def _read(self, wanted: control.ReadParameters) -> control.Values:
        image = self._image(wanted.station)
        return _snapshot(image, _slots_of(image, wanted.names))

    def _write(self, wanted: control.WriteParameters) -> control.Written:
        station = self._station(wanted.station)
        slots = _slots_of(station.image, wanted.values)
        if wanted.origin is not None and (why := self._deny_write(wanted.station, wanted.origin)):
            raise ControlError(f"station {wanted.station}: {why}", code=ErrorCode.REFUSED)
        values = {slot.name: _checked(slot, wanted.values[slot.name]) for slot in slots}
        try:
            station.write_once(Writer.APPLICATION, values)
        except WriterConflictError as exc:
            raise ControlError(str(exc), code=ErrorCode.REFUSED) from None
        except ValueError as exc:  # another type, since the station was configured anew
            raise ControlError(str(exc), code=ErrorCode.VALUE) from None
        return control.Written(len(values))

    def _stop_appliance(self, wanted: control.NoParameters) -> control.Stopping:
        del wanted
        self._stop()
        return control.Stopping(stopping=True)

    def _image(self, station: str) -> Image:
        return self._station(station).image

    def _station(self, station: str) -> StationImage:
        return of_station(station, self._images)


class Watch:
    """Events of one subscription, polled by its sender every *period_ms*."""

    def __init__(
        self,
        station: StationImage,
        names: Iterable[str],
        period_ms: int,
        *,
        only_changes: bool,
    ) -> None:
        self.period_ms = period_ms
        self._station = station
        self._names = names
        self._only_changes = only_changes
        self._last: dict[str, Any] = {}
        self._last_cycle: int | None = None
        self._skipped = 0

    def next_event(self) -> control.ValuesEvent | None:
        """Return the event to send now, None if nothing changed.

        Raises:
            ImageError: the values cannot be read.
            ControlError: the station was configured anew, and one of the variables is gone.
        """
        image = self._station.image
        now = _snapshot(image, _slots_of(image, self._names))
        if self._last_cycle is not None:
            self._skipped += max(now.cycle - self._last_cycle - 1, 0)
        self._last_cycle = now.cycle
        fields = asdict(now)
        if self._only_changes:
            last, self._last = self._last, now.values
            values = {n: v for n, v in now.values.items() if n not in last or last[n] != v}
            if not values:
                return None
            fields |= {
                "values": values,
                "quality": {n: q for n, q in now.quality.items() if n in values},
                "stale": tuple(n for n in now.stale if n in values),
            }
        skipped, self._skipped = self._skipped, 0
        return control.ValuesEvent(**fields, skipped=skipped)


def _snapshot(image: Image, slots: list[VariableSlot]) -> control.Values:
    """Return the values of *slots*; those of one writer belong to one moment.

    Values that the engine writes are those of the cycle that is named.
    """
    # The engine's values are copied between two cycles, so that all are of one cycle.
    engine = image.snapshot()
    # One value is read without copying the regions of all writers.
    if len(slots) == 1:
        (slot,) = slots
        source = engine if slot.writer is Writer.ENGINE else image
        values = {slot.name: source.read(slot.name)}
    else:
        values = engine.read_slots(slots, (Writer.ENGINE,)) | image.read_slots(slots, _OTHERS)
    plain = {p.name: datatypes.parse(p.type).to_plain(values[p.name]) for p in slots}
    cycle = engine.words[StationWord.CYCLE]
    quality, stale = _qualities(engine, plain)
    age_ns = monotonic_ns() - engine.words[StationWord.CYCLE_AT_NS]
    return control.Values(
        image.layout.station, cycle, plain, quality, time_ns=time_ns() - age_ns, stale=stale
    )


def _qualities(
    image: Image, names: Mapping[str, Any]
) -> tuple[dict[str, int | None], tuple[str, ...]]:
    """Return the quality of those of *names* that are received, and those that are stale.

    The quality is None before the first time.
    """
    parts: dict[str, list[str]] = {}
    for name in names:
        parts.setdefault(variable_of(name, image.slots), []).append(name)
    qualities: dict[str, int | None] = {}
    stale: list[str] = []
    for rx in image.layout.rx:
        first = tracker_word(image, rx)
        value = quality(image, rx) if image.words[first + RxWord.RECEIVED] else None
        is_stale = image.words[first + RxWord.STATE] == RxState.STALE
        for variable in rx.variables:
            received = parts.get(variable, ())
            qualities.update((name, value) for name in received)
            if is_stale:
                stale += received
    for field in image.layout.fields:
        age = field_quality(image, field) if image.words[field.words] else None
        # A variable with several sources is as old as the oldest of them.
        for name in parts.get(variable_of(field.variable, image.slots), ()):
            before = qualities.get(name, 0)
            qualities[name] = None if age is None or before is None else max(before, age)
            if is_late(image, field) and name not in stale:
                stale.append(name)
    return qualities, tuple(stale)


def _slots_of(image: Image, names: Iterable[str]) -> list[VariableSlot]:
    """Return the places of *names*, of all variables when there are none."""
    chosen = list(names)
    if not chosen:
        return list(image.layout.variables)
    try:
        return [image.slot(name) for name in chosen]
    except ImageError as exc:
        raise ControlError(str(exc), code=ErrorCode.UNKNOWN_NAME) from None


def _checked(slot: VariableSlot, value: Any) -> Any:
    if slot.writer is not Writer.APPLICATION:
        raise ControlError(
            f"variable {slot.name} is written by the {slot.writer}; only variables of the"
            f" application can be set",
            code=ErrorCode.REFUSED,
        )
    try:
        return datatypes.parse(slot.type).from_plain(value)
    except ValueError as exc:
        raise ControlError(f"variable {slot.name}: {exc}", code=ErrorCode.VALUE) from None
