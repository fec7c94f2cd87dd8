"""Sources in controllers, as bridges fill them: written to the process image of one station."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Mapping
from time import monotonic_ns
from typing import Any

from eap.errors import EapError
from eap.net.image_file import StationImage
from eap.pd.fieldsources import FieldSources
from eap.pd.spec import StationSpec, Writer

CHECK_S = 0.1
"""Period in which time-outs are noticed, and in which ages are written."""

logger = logging.getLogger(__name__)


class FieldPlayer:
    """The sources in controllers of one station, which may get others while it runs.

    Args:
        station: The station.
        image: Its process image.

    Attributes:
        station: The station, as it is configured now.
    """

    def __init__(self, station: StationSpec, image: StationImage) -> None:
        self.station = station
        self._image = image
        self._sources = FieldSources(station)
        layout, words = image.image.layout, image.image.words
        self._sources.resume({slot.variable: words[slot.words] for slot in layout.fields})

    def change(self, station: StationSpec) -> None:
        """Take the sources of *station* from now on."""
        self.station = station
        self._sources = FieldSources(station, self._sources)

    def unknown(self, names: Mapping[str, Any]) -> list[str]:
        """Return those of *names* that have no source in a controller."""
        return self._sources.unknown(names)

    def fill(self, values: Mapping[str, Any]) -> None:
        """Write values, in plain form, that a bridge has just read.

        Raises:
            ValueError: one is not a value of its variable; nothing was written.
            ImageError: the image cannot be written now.
        """
        self._write(self._sources.fill(values, monotonic_ns()))

    async def serve(self) -> None:
        """Write substitutes and ages until cancelled."""
        complaint = ""
        while True:
            if self._sources:
                try:
                    self._write(self._sources.check(monotonic_ns()))
                    complaint = ""
                # A value that no longer fits: the station is just being changed.
                except (EapError, ValueError) as exc:
                    if str(exc) != complaint:
                        complaint = str(exc)
                        logger.warning("%s: sources keep their values: %s", self.station.name, exc)
            await asyncio.sleep(CHECK_S)

    def _write(self, values: Mapping[str, Any]) -> None:
        self._image.acquire_writer(Writer.SERVICES)
        self._image.write(Writer.SERVICES, values)
        image, moments = self._image.image, self._sources.moments()
        # All of them each time: a new image begins without.
        for slot in image.layout.fields:
            image.words[slot.words] = moments.get(slot.variable, 0)


def controller_findings(stations: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the controllers with late values, as findings; *stations* are those of ``status``."""
    return [
        {
            "severity": "warning",
            "where": f"{station['name']} {each['name']}",
            "what": f"{each['late']} of {each['sources']} values of the controller are late",
            "advice": "its bridge in 'eapctl status' has the reason",
            "since": None,
        }
        for station in stations
        for each in station.get("controllers", ())
        if each["late"]
    ]
