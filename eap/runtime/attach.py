"""A user program's view of a running station: its variables by name, in step with its cycle.

    with eap.attach("island-01") as station:
        while True:
            station["setpoint"] = station["left_level"] * 2
            station.wait_cycle()

Nothing here talks to a process: variables are read and written in the shared process image.  When
the plant is changed and the image gets a new layout, the program moves there by itself.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from enum import Enum
from pathlib import Path
from time import monotonic_ns, time_ns
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from eap.closeable import Closeable
from eap.errors import EngineGoneError, ImageError, WriterConflictError
from eap.net.image_file import StationImage
from eap.pd.image import Image
from eap.pd.layout import VAR_CTRL
from eap.pd.report import station_status
from eap.pd.spec import Writer
from eap.pd.txframe import EVENT_BIT
from eap.pd.words import StationWord
from eap.runtime.folder import describe_roots, find_running

T = TypeVar("T")

_GONE_AFTER_S = 2.0
"""Without a cycle for this long the engine counts as gone; a restart takes less."""
_GONE_AFTER_CYCLES = 10


class AttachedStation(Closeable):
    """The variables of one running station; made by :func:`attach`."""

    def __init__(self, path: Path) -> None:
        self._station = StationImage(path)
        self._file = self._station.file
        self._opened_ns = monotonic_ns()
        self._writes = False

    def close(self) -> None:
        """Detach, and release the right to write."""
        self._station.close()

    @property
    def name(self) -> str:
        """The station's name."""
        return self._file.image.layout.station

    @property
    def cycle_s(self) -> float:
        """The station's device cycle in seconds."""
        return self._file.image.layout.cycle_us / 1e6

    @property
    def cycle(self) -> int:
        """The station's cycle counter; its low 16 bits are what frames carry."""
        return int(self._current().words[StationWord.CYCLE])

    def __getitem__(self, name: str) -> Any:
        """Return the value of the variable *name*, or of a part such as ``axis.position``."""
        return self._current().read(name)

    def __setitem__(self, name: str, value: Any) -> None:
        """Write one variable or part of one, which leaves its other parts; see :meth:`write`."""
        self.write({name: value})

    def read_all(self) -> dict[str, Any]:
        """Return all variables; those of one writer belong to the same cycle."""
        return self._current().read_all()

    def read_as(self, name: str, kind: type[T]) -> T:
        """Return a struct, or a part of one, as the dataclass or msgspec record *kind*.

        Its fields have the names of members; a member without a field is left out.

        Raises:
            ValueError: it is no struct, or a field has no member.
        """
        return to_record(self[name], kind)

    def write(self, values: Mapping[str, Any]) -> None:
        """Write several variables at once: the engine sees all of them or none.

        Raises:
            WriterConflictError: one of them is not the application's, or another program writes.
            ValueError: a value does not fit its type; nothing was written.
            EngineGoneError: no engine runs the station.
        """
        image = self._current()
        for name in values:
            slot = image.slot(name)
            if slot.writer is not Writer.APPLICATION:
                raise WriterConflictError(
                    f"station {self.name}: {name} is written by the {slot.writer}, "
                    f"not by applications",
                    holder=slot.writer,
                )
        if not self._writes:
            self._station.acquire_writer(Writer.APPLICATION)
            self._writes = True
        self._station.write(Writer.APPLICATION, values)

    def fire(self, pd: str) -> None:
        """Send the TxPD *pd* in the next cycle.

        Raises:
            ImageError: the station sends no such PD, or its trigger does not say ``event``.
        """
        by_event = [slot.name for slot in self._file.image.layout.tx if slot.event]
        if pd not in by_event:
            listed = ", ".join(by_event) or "none"
            raise ImageError(
                f"station {self.name} sends no PD {pd!r} by event; those with event: true: {listed}"
            )
        name = pd + VAR_CTRL
        control = self[name]
        if control & EVENT_BIT:  # the engine has to see it low before it can rise
            self.write({name: control & ~EVENT_BIT})
            self.wait_cycle()
        self.write({name: control | EVENT_BIT})

    def wait_cycle(self) -> int:
        """Sleep until the next cycle has run and return its number.

        Raises:
            EngineGoneError: no engine runs the station any more.
        """
        image = self._current()
        before = image.words[StationWord.CYCLE]
        # The wait ends early without a cycle: in a new layout, or when the engine is gone.
        while not self._file.wait_cycle(before, self._gone_after_s()):
            image = self._current()  # a new layout, which counts on, or the engine is gone
        return int(image.words[StationWord.CYCLE])

    def status(self) -> dict[str, Any]:
        """Return the counters and states of the station, shaped as in ``eapctl status``."""
        return station_status(self._current().snapshot(), monotonic_ns(), time_ns())

    def _current(self) -> Image:
        """Return the image, of the newest layout and with an engine behind it."""
        file = self._station.file
        if file is not self._file:
            self._file = file
            self._opened_ns = monotonic_ns()
        image = file.image
        ran_at_ns = image.words[StationWord.CYCLE_AT_NS]
        silent_s = (monotonic_ns() - (ran_at_ns or self._opened_ns)) / 1e9
        # An engine that died between renaming the new file and retiring the old one left no mark
        # there.
        if silent_s > self._gone_after_s() and self._station.reopen_if_replaced():
            return self._current()
        if silent_s > self._gone_after_s():
            missed = "a cycle" if ran_at_ns else "its first cycle"
            raise EngineGoneError(
                f"station {self.name}: its engine has not run {missed} for {silent_s:.1f} s; "
                f"start the plant again"
            )
        return image

    def _gone_after_s(self) -> float:
        return max(_GONE_AFTER_S, _GONE_AFTER_CYCLES * self.cycle_s)


def attach(station: str, *, plant: str = "") -> AttachedStation:
    """Attach to the running station of that name.

    Args:
        station: Its name.
        plant: Name of its plant; needed when several that run have a station of this name.

    Raises:
        ImageError: no appliance of this user runs such a station, or several do; the message names
            those that run.
    """
    running = [(folder, info) for folder, info in find_running() if plant in {"", info.plant}]
    found = [(folder, info) for folder, info in running if station in info.stations]
    if not found:
        listed = ", ".join(sorted(name for _, info in running for name in info.stations)) or "none"
        raise ImageError(
            f"no station {station!r} runs here (running: {listed}; looked in {describe_roots()} as "
            f"user {os.getuid()}): start its plant with eapctl run"
        )
    if len(found) > 1:
        plants = ", ".join(info.plant for _, info in found)
        raise ImageError(f"station {station} runs in {plants}: choose one with plant=")
    return AttachedStation(found[0][0].image(station))


def to_record(value: Any, kind: type[T]) -> T:
    """Return the value of a struct as *kind*, whose fields have the names of members.

    Members without a field are left out.  A field of another record, of an ``Enum``, or of a list
    or tuple of these is converted; every other value is taken as it is.

    Raises:
        ValueError: *kind* is no record, or has a field without a member.
    """
    names = _field_names(kind)
    if names is None or not isinstance(value, dict):
        expected = "a struct for a dataclass or msgspec record"
        raise ValueError(f"{value!r:.60} as {kind.__name__}: expected {expected}")
    missing = [name for name in names if name not in value]
    if missing:
        known = ", ".join(value)
        raise ValueError(f"{kind.__name__} has a field {missing[0]!r}: expected one of {known}")
    hints = get_type_hints(kind)
    return kind(**{name: _converted(value[name], hints[name]) for name in names})


def _field_names(kind: Any) -> Iterable[str] | None:
    fields: Iterable[str] | None = getattr(kind, "__dataclass_fields__", None)
    return getattr(kind, "__struct_fields__", None) if fields is None else fields


def _converted(value: Any, hint: Any) -> Any:
    if isinstance(value, tuple):
        items = get_args(hint)
        item = items[0] if items else Any
        elements = [_converted(each, item) for each in value]
        return elements if get_origin(hint) is list else tuple(elements)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(int(value))
    return value if _field_names(hint) is None else to_record(value, hint)
