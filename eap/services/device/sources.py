"""Variables that services provides: measurements of this host and columns of CSV files."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.codec import datatypes
from eap.codec.datatypes import DataType, find_variable, variable_of
from eap.errors import EnvironmentalError, ImageError
from eap.net.host import Host, open_replay
from eap.net.image_file import StationImage
from eap.pd.spec import CsvSource, HostSource, Source, StationSpec, Writer

logger = logging.getLogger(__name__)


class SourcePlayer:
    """The sources of one station, which may get others while it runs."""

    def __init__(self, station: StationSpec, image: StationImage) -> None:
        self._station = station
        self._image = image
        self._changed = asyncio.Event()

    def change(self, station: StationSpec) -> None:
        """Play those of *station* from now on; the same ones just go on."""
        is_same = _sources(station) == _sources(self._station)
        self._station = station
        if not is_same:
            self._changed.set()

    async def serve(self) -> None:
        """Play until cancelled; raises as :func:`play_sources` does."""
        async with asyncio.TaskGroup() as group:
            while True:
                playing = group.create_task(play_sources(self._station, self._image))
                await self._changed.wait()
                self._changed.clear()
                playing.cancel()
                await asyncio.wait([playing])


async def play_sources(station: StationSpec, image: StationImage) -> None:
    """Write every host and CSV source of *station* in its own rhythm until cancelled.

    Raises:
        WriterConflictError: another process writes these variables.
    """
    types = {variable.name: datatypes.parse(variable.type) for variable in station.variables}

    def kind_of(name: str) -> DataType:
        found = find_variable(name, types.get)
        if found is None:  # the checks of the configuration have found it
            raise LookupError(name)
        return found[1].kind

    host = Host()
    players: list[tuple[HostSource | CsvSource, Callable[[], Any]]] = []
    for source in station.sources:
        try:
            if isinstance(source, HostSource):
                players.append((source, _measure(source, host, kind_of(source.variable))))
            elif isinstance(source, CsvSource):
                players.append((source, _replay(source, kind_of(source.variable))))
        except EnvironmentalError as exc:
            # It was there when the plant was checked; everything else goes on without it.
            logger.warning("%s/%s keeps its value: %s", station.name, source.variable, exc)
    if not players:
        return
    image.acquire_writer(Writer.SERVICES)
    async with asyncio.TaskGroup() as group:
        for source, feed in players:
            label = f"{station.name}/{source.variable}"
            group.create_task(_play(image, label, source.variable, source.period_ms, feed))


async def _play(
    image: StationImage, label: str, variable: str, period_ms: int, feed: Callable[[], Any]
) -> None:
    """Write the next value each *period_ms*; periods that came too late are left out."""
    clock = asyncio.get_running_loop().time
    due = clock()
    complaint = ""
    while True:
        try:
            image.write(Writer.SERVICES, {variable: feed()})
            complaint = ""
        except (EnvironmentalError, ImageError, ValueError) as exc:
            if str(exc) != complaint:
                complaint = str(exc)
                logger.warning("%s keeps its value: %s", label, exc)
        # Periods that were missed are left out, not made up for.
        due = max(due + period_ms / 1000, clock())
        await asyncio.sleep(due - clock())


def _sources(station: StationSpec) -> list[tuple[Source, str]]:
    """Return the sources that services plays, with the types of their variables."""
    # The same source with another type of its variable has to be started again.
    types = {variable.name: variable.type for variable in station.variables}
    played = (each for each in station.sources if isinstance(each, (HostSource, CsvSource)))
    return [(each, types[variable_of(each.variable, types)]) for each in played]


def _measure(source: HostSource, host: Host, kind: DataType) -> Callable[[], Any]:
    return lambda: fit(host.read(source.measure, source.argument), kind)


def _replay(source: CsvSource, kind: DataType) -> Callable[[], Any]:
    replay = open_replay(Path(source.file), source.column, period_ms=source.period_ms)
    start_ns = monotonic_ns()
    return lambda: kind.parse_text(replay.value(monotonic_ns() - start_ns))


def fit(number: float, kind: DataType) -> float:
    """Return *number* as near as *kind* can hold it."""
    limits = kind.scalar_range
    if limits is None or isinstance(limits[0], float):
        return number
    return min(max(round(number), limits[0]), limits[1])
